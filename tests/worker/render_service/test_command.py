"""Proves that the renderer refuses settings that it cannot use with a sentence. That it serves: see test_renderer."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow  # starts the program
@pytest.mark.parametrize("size", ["rubbish", "-5", "nan"])
def test_a_cache_size_that_is_none_is_refused_with_a_sentence(tmp_path: Path, size: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "splatmill_worker", "renderer", "--uds", str(tmp_path / "r.sock")],
        env=dict(os.environ) | {"SPLATMILL_STORAGE": str(tmp_path), "SPLATMILL_RENDER_CACHE": size},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert done.stderr == (
        f"SPLATMILL_RENDER_CACHE cannot be used: {size!r} is not a size; write bytes (500000000), or 500MB, 1.5GB, "
        "2GiB.\n"
    )
