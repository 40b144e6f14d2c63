"""Proves that a worker that is started without Redis ends with a sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def test_a_worker_started_by_hand_says_that_redis_is_away(tmp_path: Path) -> None:
    environment = dict(os.environ) | {"REDIS_URL": f"unix://{tmp_path}/nothing.sock"}
    code = "import splatmill_worker.service.command as c; c.REDIS_WAIT = 0.1; raise SystemExit(c.serve(None))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "nothing.sock" in done.stderr
    assert "REDIS_URL" in done.stderr
