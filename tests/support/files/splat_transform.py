"""PlayCanvas's splat-transform, a converter that is not ours: the second reader and writer of the tests of formats.

It is a development dependency of `server/web/package.json`, and runs in Node.
"""

import subprocess
from pathlib import Path

from tests.support.paths import ROOT
from tests.support.programs import node

PROGRAM = ROOT / "server/web/node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def convert(source: Path, target: Path, *options: str) -> None:
    """Convert a file by splat-transform. Skips the test where it is not installed."""
    done = subprocess.run(
        [*node("@playcanvas/splat-transform"), str(PROGRAM), "-q", "-w", str(source), str(target), *options],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
