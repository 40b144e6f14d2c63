"""A COLMAP model is written whole, or its writer fails; and COLMAP's own words for a disk that is full are known.

Disks are full here by a limit of the size of a file, which COLMAP does not notice either, in a process of its own.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from splatmill_worker.colmap import pycolmap, write_model
from splatmill_worker.service.attempts.problems import keeps_progress, problem_of

LIMITED = """
import resource, signal, sys
from pathlib import Path
from splatmill_worker.colmap import pycolmap, write_model
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
folder, limit = Path(sys.argv[1]), int(sys.argv[2])
model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions())
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
"""


def limited(folder: Path, limit: int, program: str) -> str:
    """Run a program that may write files of `limit` bytes, and return the error that ended it."""
    command = [sys.executable, "-c", LIMITED + program, str(folder), str(limit)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 1, ended.stderr
    return ended.stderr.strip().splitlines()[-1]


@pytest.mark.parametrize("text", [False, True])
def test_a_model_that_is_written_can_be_read(text: bool, tmp_path: Path) -> None:
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions())
    write_model(model, tmp_path, text=text)
    assert pycolmap.Reconstruction(tmp_path).num_points3D() == model.num_points3D() > 0


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("limit", [0, 100, 5000])
def test_a_model_that_does_not_fit_on_the_disk_is_an_error(limit: int, text: bool, tmp_path: Path) -> None:
    error = limited(tmp_path, limit, f"write_model(model, folder, text={text})")
    assert error.startswith("OSError: [Errno 28] No space left on device"), error


@pytest.mark.parametrize("limit", [1000, 200_000])
def test_a_database_that_does_not_fit_on_the_disk_is_a_full_storage(limit: int, tmp_path: Path) -> None:
    error = limited(
        tmp_path,
        limit,
        "database = pycolmap.Database.open(folder / 'database.db')\n"
        "pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(), database)\n",
    )
    assert error.startswith("RuntimeError: "), error
    raised = RuntimeError(error.removeprefix("RuntimeError: "))
    assert problem_of(raised).code == "storage_full"
    assert keeps_progress(raised)
