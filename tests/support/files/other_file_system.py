"""A folder on another file system than that of pytest's temporary folders: hard links between the two fail."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

MEMORY = Path("/dev/shm")


@pytest.fixture
def other_file_system(tmp_path: Path) -> Iterator[Path]:
    if not os.access(MEMORY, os.W_OK) or MEMORY.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip(f"{MEMORY} is not a second file system that can be written to")
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        yield Path(folder)
