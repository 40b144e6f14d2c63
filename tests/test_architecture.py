"""The rules of ARCHITECTURE.md that a machine can check: imports, file sizes, stems, and that imports stay cheap.

Does not prove that the design is good, only that the code still follows it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PARTS = {
    "splatmill": ROOT / "client" / "splatmill",
    "splatmill_server": ROOT / "server" / "splatmill_server",
    "splatmill_worker": ROOT / "worker" / "splatmill_worker",
}
OPS = ("project", "bin", "composite", "loss", "adam", "knn")


def sources() -> list[Path]:
    folders = [*PARTS.values(), ROOT / "worker" / "bench", ROOT / "tests"]
    return [p for f in folders for p in f.rglob("*") if p.suffix in {".py", ".cpp", ".hpp", ".html"}]


def test_import_rules_hold():
    lint = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_file_is_over_600_lines():
    long = {str(p.relative_to(ROOT)): n for p in sources() if (n := len(p.read_text().splitlines())) > 600}
    assert not long


@pytest.mark.parametrize("backend", ["reference", "cpu", "gpu"])
def test_every_backend_has_the_same_stems(backend: str):
    folder = PARTS["splatmill_worker"] / "kernels" / backend
    stems = {p.stem for p in folder.rglob("*")}
    assert set(OPS) <= stems


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        ("splatmill", {"torch", "numpy", "redis", "rq", "obstore", "fastapi"}),
        ("splatmill.schema", {"torch", "numpy", "redis", "rq", "obstore", "fastapi"}),
        ("splatmill_server.app", {"torch", "numpy", "pycolmap", "splatmill_worker"}),
        # The queue worker forks an attempt; torch's and COLMAP's threads do not survive a fork.
        ("splatmill_worker.service.rq_worker", {"torch", "pycolmap", "splatmill_server"}),
        ("splatmill_worker.kernels", {"triton", "pycolmap", "redis", "splatmill"}),
    ],
)
def test_importing_stays_cheap(module: str, forbidden: set[str]):
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert forbidden.isdisjoint(done.stdout.split())


def test_every_test_file_says_what_it_proves():
    mute = [
        str(p.relative_to(ROOT))
        for p in (ROOT / "tests").rglob("test_*.py")
        if '"""' not in p.read_text()[:8]
    ]
    assert not mute


def test_every_type_ignore_has_its_reason():
    bare = re.compile(r"# type: ignore(\[[a-z, -]+\])?\s*$", re.M)
    places = [str(p.relative_to(ROOT)) for p in sources() if p.suffix == ".py" and bare.search(p.read_text())]
    assert not places
