"""The flight over the generated ground: its density, the GPS of its photos, its true cameras, and its command.

Does not prove that cameras are recovered from every flight: one small flight is tried.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images import exif
from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ground import Flight, capture
from splatmill_worker.synthetic.ground.command import main
from splatmill_worker.synthetic.ground.flight import local
from tests.support.scenes.poses import pose_errors

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    folder = tmp_path_factory.mktemp("flown")
    return folder, capture(folder, 15, 320, 240, seed=1)


@pytest.mark.parametrize("count", [60, 1000])
def test_neighbours_overlap_as_stated_and_the_area_grows_with_the_photos(count: int) -> None:
    flight = Flight(drift=0.0)
    cameras = flight.cameras(count, 640, 480, 0)
    places = np.array([camera.center for camera in cameras])
    assert len(cameras) == count
    assert np.allclose(places[:, 2], flight.height)
    width, height = (flight.height * side / cameras[0].fx for side in (640, 480))
    strips, lengths = np.unique(np.round(places[:, 0], 6), return_counts=True)
    assert np.allclose(np.diff(strips), (1 - flight.side) * width)
    assert lengths.max() - lengths.min() <= 1
    along = np.abs(np.diff(places[:, 1]))[np.abs(np.diff(places[:, 0])) < 1e-6]
    assert np.allclose(along, (1 - flight.forward) * height)
    # As wide as long, to within a strip: the area of a photo is the same whatever their number.
    across, length = len(strips) * (1 - flight.side) * width, lengths.mean() * (1 - flight.forward) * height
    assert across == pytest.approx(length, abs=(1 - flight.side) * width)


def test_gps_errs_by_the_stated_deviation() -> None:
    flight = Flight(gps=2.0)
    cameras = flight.cameras(1500, 64, 48, 0)
    errors = local(flight.measured(cameras, 0)) - np.array([camera.center for camera in cameras])
    # The deviation of 1500 samples is known to 1.8 % (one sigma).
    assert errors.std(0) == pytest.approx([2.0, 2.0, 4.0], rel=0.08)
    assert np.abs(errors.mean(0)).max() < 0.4


def test_photos_carry_what_the_receiver_measured_and_the_focal_length(
    flown: tuple[Path, dict[str, Camera]],
) -> None:
    folder, cameras = flown
    measured = Flight().measured(list(cameras.values()), 1)
    for name, expected in zip(cameras, measured, strict=True):
        with Image.open(folder / "photos" / name) as photo:
            assert photo.size == (320, 240)
            tags = exif.read(photo)
        assert tags.latitude is not None
        assert tags.longitude is not None
        assert tags.altitude is not None
        place = np.array([[tags.latitude, tags.longitude, tags.altitude]])
        assert np.abs(local(place) - local(expected[None])).max() < 0.01
        assert tags.focal_in_diagonals is not None
        assert tags.focal_in_diagonals * 43.267 == pytest.approx(35 * 0.75, abs=0.5)


def test_the_truth_is_a_colmap_model_beside_the_photos(flown: tuple[Path, dict[str, Camera]]) -> None:
    folder, cameras = flown
    assert sorted(p.name for p in folder.iterdir()) == ["photos", "truth"]
    model = pycolmap.Reconstruction(folder / "truth")
    poses = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    assert poses.keys() == cameras.keys()
    for name, camera in cameras.items():
        assert np.abs(poses[name] - camera.viewmat[:3]).max() < 1e-9
    (lens,) = model.cameras.values()
    assert lens.params.tolist() == [240.0, 240.0, 160.0, 120.0]


def test_the_cameras_of_a_small_flight_are_recovered(
    flown: tuple[Path, dict[str, Camera]], tmp_path: Path
) -> None:
    folder, cameras = flown
    scene = sfm.reconstruct(
        folder / "photos", None, tmp_path, sfm.SfmOptions(), lambda *_: None, lambda: False
    )
    assert len(scene.views) == len(cameras)
    turns, shifts = pose_errors(scene, cameras)
    # 0.1 to 0.5 degrees for six seeds: fifteen small photos hardly hold the shape of the ground.
    assert np.median(turns) < 0.6
    assert shifts.max() < 0.01


def test_the_command_writes_a_capture_and_says_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path), "--photos", "2", "--width", "48", "--height", "32", "--samples", "1"]
    assert main(words) == 0
    assert f"2 photos of the generated ground are in {tmp_path / 'photos'}" in capsys.readouterr().out
    assert len(list((tmp_path / "photos").glob("*.jpg"))) == 2
    assert main(words) == 1
    assert "There are files already; choose another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--photos", "1"], "--photos 1: a flight has 2 to 100,000 photos"),
        (["--width", "8"], "--width 8: a side has 32 to 8192 pixels"),
        (["--samples", "0"], "--samples 0: a pixel has 1 to 8 rays"),
        (["--seed", "-1"], "--seed -1: a seed is 0 or larger"),
        (["--gps", "nan"], "--gps nan: the standard deviation is 0 to 1000 metres"),
        (["--photos", "many"], "invalid int value: 'many'"),
    ],
)
def test_bad_input_is_refused_with_the_bound(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], reason: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "out"), *words])
    assert ended.value.code == 2
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
