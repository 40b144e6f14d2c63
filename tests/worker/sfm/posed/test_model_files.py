"""Proves that COLMAP models of strangers are read without points, and refused by name when they are damaged or lie.

That each refusal costs little memory is proved by its limit: the process may not take more.
"""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatmill_worker.colmap import pycolmap
from splatmill_worker.readers import colmap_files, point_file
from splatmill_worker.sfm import posed
from splatmill_worker.sfm.posed import model_files, transforms
from splatmill_worker.sfm.posed.files import ImageFiles
from tests.support.decoding.reader_peak import peaks
from tests.support.hostile import model_bombs, models, pictures
from tests.support.hostile.pictures import write

READ = "splatmill_worker.sfm.posed.model_files:read"


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
    assert sorted(model.images) == [1, 2, 3]
    np.testing.assert_allclose(model.images[2].viewmat[:3, 3], [2.0, 0.0, 5.0])
    assert len(model.points.errors) == 0


def test_a_capture_with_a_model_without_points_has_cameras(tmp_path: Path) -> None:
    text(tmp_path / "poses")
    (tmp_path / "poses/points3D.txt").unlink()
    for number in range(3):
        write(tmp_path / "images" / f"{number + 1}.jpg", pictures.photo(number))
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert [view.name for view in scene.views] == ["1.jpg", "2.jpg", "3.jpg"]
    assert scene.points.shape == (0, 3)


LOAD = """
import resource, sys
from pathlib import Path
from splatmill_worker.sfm.posed import model_files, transforms
from splatmill_worker.sfm.posed.files import ImageFiles
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
for folder in sys.argv[1:]:
    try:
        model_files.read(Path(folder))
    except ValueError as error:
        print(error)
"""

PEAKS_ONLY = pytest.mark.skipif(sys.platform != "linux", reason="peaks are read from /proc")


@pytest.mark.slow
@PEAKS_ONLY
def test_small_files_do_not_become_large(tmp_path: Path) -> None:
    """Points of text take COPIES times their file at most; files that announce more entries than are read, little."""
    folders = {
        "small": text(tmp_path / "small"),
        "points": text(tmp_path / "points", points3D=model_bombs.dense_text(500_000)),
        "cameras": text(
            tmp_path / "cameras",
            cameras="".join(f"{number} FOV 9 9 1 1 1 1 1\n" for number in range(300_000)),
        ),
        "images": binary(tmp_path / "images", images=model_bombs.short_images(2_000_000)),
        "track": text(tmp_path / "track", points3D="1 0 0 0 9 9 9 0.5" + " 1 0" * 10**7),
        "features": text(
            tmp_path / "features", images="1 1 0 0 0 1 0 5 1 1.jpg\n" + "0 0 -1 " * 5_000_000 + "\n"
        ),
    }
    outcomes = dict(zip(list(folders)[1:], peaks(READ, list(folders.values())), strict=True))
    assert outcomes["points"][1] == "read"
    assert outcomes["points"][0] < colmap_files.COPIES * (folders["points"] / "points3D.txt").stat().st_size
    assert "more than 200000 cameras" in outcomes["cameras"][1]
    assert "more than 200000 images" in outcomes["images"][1]
    assert "line 1 has 1048576 bytes or more" in outcomes["track"][1]
    assert outcomes["features"][1] == "read"
    assert all(size < 200 * 10**6 for size, _ in outcomes.values()), outcomes


def parsed(path: Path) -> None:
    """Parse a transforms.json of a capture without photos."""
    transforms._parsed(path, ImageFiles(path.parent, {}, {}))


@pytest.mark.slow
@PEAKS_ONLY
def test_points_and_transforms_that_would_fill_the_memory_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "small.json", models.transforms())
    write(tmp_path / "nested.json", model_bombs.nested_json(10**7))
    ((size, said),) = peaks(f"{__name__}:parsed", [tmp_path / "small.json", tmp_path / "nested.json"])
    assert "its lists and objects would take 1.3 GB" in said
    assert size < 100 * 10**6
    write(tmp_path / "small.ply", models.ply(3))
    write(tmp_path / "points.ply", model_bombs.ply_of_bytes(1_000_000))
    ((size, said),) = peaks(
        "splatmill_worker.readers.point_file:read", [tmp_path / "small.ply", tmp_path / "points.ply"]
    )
    assert said == "read"
    assert size < point_file.POINT_BYTES * 1_000_000


def test_the_table_of_camera_models_is_that_of_colmap() -> None:
    expected = {
        int(kind.value): (kind.name, len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params))
        for kind in pycolmap.CameraModelId.__members__.values()
        if kind.name != "INVALID"
    }
    assert expected == colmap_files.MODELS


def test_text_is_read_with_comments_features_and_names_of_several_words(tmp_path: Path) -> None:
    images = "# a comment\n\n7 1 0 0 0 1 2 3 1 a b.jpg\n1.5 2.5 4 3 4 -1\n9 0 0 0 1 4 5 6 1 c.jpg"
    points = "4 1 2 3 10 20 30 0.25 7 0 9 1 7 2\n5 4 5 6 1 2 3 0.5\n"
    model = model_files.read(text(tmp_path, images=images, points3D=points))
    assert {number: image.name for number, image in model.images.items()} == {7: "a b.jpg", 9: "c.jpg"}
    np.testing.assert_allclose(model.images[9].viewmat[:3], [[-1, 0, 0, 4], [0, -1, 0, 5], [0, 0, 1, 6]])
    np.testing.assert_array_equal(model.points.positions, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(model.points.colors, [[10, 20, 30], [1, 2, 3]])
    np.testing.assert_array_equal(model.points.errors, [0.25, 0.5])
    np.testing.assert_array_equal(model.points.offsets, [0, 3, 3])
    np.testing.assert_array_equal(model.points.images, [7, 9, 7])


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
        ({"cameras": "1 EQUIRECTANGULAR 64 48 64 48\n"}, "EQUIRECTANGULAR"),
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
