"""PlayCanvas's splat-transform, a converter that is not ours: the second reader and writer of the tests of formats.

It is a development dependency of `server/web/package.json`, and runs in Node.
"""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PROGRAM = ROOT / "server/web/node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def convert(source: Path, target: Path, *options: str) -> None:
    """Convert a file by splat-transform. Skips the test where Node or the program is missing."""
    node = shutil.which("node")
    if node is None or not PROGRAM.is_file():
        pytest.skip("needs Node and splat-transform: run `python server/web/packages.py fetch --dev`")
    done = subprocess.run(
        [node, str(PROGRAM), "-q", "-w", str(source), str(target), *options],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
