"""Proves that COLMAP models of strangers are read without points, and refused by name when they are damaged or lie.

That each refusal costs little memory is proved by its limit: the process may not take more.
"""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import model_files
from tests.support.hostile import models, pictures
from tests.support.hostile.pictures import write


def text(folder: Path, **changes: str) -> Path:
    for name, content in (models.text() | changes).items():
        write(folder / f"{name}.txt", content.encode())
    return folder


def binary(folder: Path, **changes: bytes) -> Path:
    for name, content in (models.binary() | changes).items():
        write(folder / f"{name}.bin", content)
    return folder


@pytest.mark.parametrize("make", [text, binary])
@pytest.mark.parametrize("points", ["as written", "empty", "missing"])
def test_points_may_be_missing(tmp_path: Path, make: type[Path], points: str) -> None:
    folder = make(tmp_path)
    (path,) = folder.glob("points3D.*")
    if points == "empty":
        path.write_bytes(b"")
    elif points == "missing":
        path.unlink()
    model = model_files.read(folder)
    assert model.num_reg_images() == 3
    np.testing.assert_allclose(model.images[2].cam_from_world().translation, [2.0, 0.0, 5.0])


def test_a_capture_with_a_model_without_points_has_cameras(tmp_path: Path) -> None:
    text(tmp_path / "poses")
    (tmp_path / "poses/points3D.txt").unlink()
    for number in range(3):
        write(tmp_path / "images" / f"{number + 1}.jpg", pictures.photo(number))
    found = posed.find(tmp_path)
    assert found is not None
    scene = found.load()
    assert [view.name for view in scene.views] == ["1.jpg", "2.jpg", "3.jpg"]
    assert scene.points.shape == (0, 3)


LOAD = """
import resource, sys
from pathlib import Path
from splatmill_worker.sfm.posed import model_files
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
for folder in sys.argv[1:]:
    try:
        model_files.read(Path(folder))
    except ValueError as error:
        print(error)
"""

HUGE = struct.pack("<Q", 1 << 50)

BEYOND = [
    ("cameras", HUGE),
    ("images", HUGE),
    ("points3D", HUGE),
    ("points3D", models.point_with_track(1 << 40)),
    ("images", models.image_with_points(1 << 40)),
    ("images", b"\x01"),
    ("cameras", models.binary()["cameras"][:-4]),
]
"""A file of a model, and bytes whose counts announce more than follows."""


def test_counts_beyond_the_file_cost_no_memory(tmp_path: Path) -> None:
    """One process reads them all, with 256 MiB to spare."""
    folders = [tmp_path / str(index) for index in range(len(BEYOND))]
    for folder, (file, content) in zip(folders, BEYOND, strict=True):
        folder.mkdir()
        binary(folder, **{file: content})
    done = subprocess.run(
        [sys.executable, "-c", LOAD, *folders], capture_output=True, text=True, timeout=120, check=True
    )
    said = done.stdout.splitlines()
    assert len(said) == len(BEYOND), done.stdout
    for line, (file, _) in zip(said, BEYOND, strict=True):
        assert line.startswith(f"{file}.bin could not be read: it announces")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"cameras": ""}, "no cameras.txt, or an empty one"),
        ({"cameras": "1 PINHOLE 0 48 60 60 32 24\n"}, "0 x 48"),
        ({"cameras": "1 PINHOLE 64 48 -60 60 32 24\n"}, "has the parameters"),
        ({"cameras": "1 EQUIRECTANGULAR 64 48 64 48\n"}, "spherical"),
        ({"cameras": "1 UNHEARD_OF 64 48 60\n"}, "could not be read"),
        ({"images": "1 0 0 0 0 1 0 5 1 1.jpg\n\n"}, "rotation of '1.jpg'"),
        ({"images": "1 1 0 0 0 1e300 0 5 1 1.jpg\n\n"}, "translation of '1.jpg'"),
        ({"images": "1 1 0 0 0 1 0 5 9 1.jpg\n\n"}, "could not be read"),
        ({"points3D": "1 0 0 0 1 1 1 0.5 77 0\n"}, "could not be read"),
    ],
)
def test_what_no_camera_can_be_is_named(tmp_path: Path, changes: dict[str, str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        model_files.read(text(tmp_path, **changes))


def test_poses_that_are_not_finite_are_named(tmp_path: Path) -> None:
    images = models.binary()["images"].replace(struct.pack("<d", 2.0), struct.pack("<d", float("nan")))
    with pytest.raises(ValueError, match=r"translation of '2.jpg'"):
        model_files.read(binary(tmp_path, images=images))
