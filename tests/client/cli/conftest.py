"""What the tests of the command line share: a folder of photos that nobody decodes, and small models in files."""

from pathlib import Path

import pytest

from tests.support.ball import write_ply

PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0"
"""A model of one Gaussian, as the server counts them."""


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for n in range(3):
        (folder / f"{n}.jpg").write_bytes(bytes([n]) * 1000)
    (folder / "notes.txt").write_text("not a photo")
    return folder


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    write_ply(tmp_path / "ball.ply", 500)
    return tmp_path / "ball.ply"
