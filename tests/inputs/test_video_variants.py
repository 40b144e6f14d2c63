"""Videos as phones and converters write them give the cameras and the colours of the plain SDR frames: HDR (HLG),
stamps that begin at one hour, and pixels that are not square."""

from __future__ import annotations

import math
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.images.prepare import prepare
from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ray_caster import look_at, picture, still_life
from tests.inputs.conftest import INPUTS, run_script
from tests.support.made_once import made_once

FRAMES, FOCAL_LENGTH = 24, 315.0
"""Of the video, before it is encoded."""

VIDEOS = {"hlg.mov": "HDR", "late.mkv": "does not name", "anamorphic.mp4": "not square"}
"""The videos, each with a part of its warning."""


def cameras() -> list[Camera]:
    """The camera of each frame, three quarters of the way around the scene."""
    angles = [2 * math.pi * number / FRAMES * 0.75 for number in range(FRAMES)]
    eyes = [
        3.7 * np.array([math.cos(a) * math.cos(0.5), math.sin(a) * math.cos(0.5), math.sin(0.5)])
        for a in angles
    ]
    return [look_at(eye, np.array([0, 0, 0.25]), 384, 288, FOCAL_LENGTH) for eye in eyes]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `videos`, and `vid.npy`, the frames that the script of the inputs makes them from."""

    def make(folder: Path) -> None:
        np.save(folder / "vid.npy", np.stack([picture(still_life(0), camera, 2) for camera in cameras()]))
        (folder / "cameras.pkl").write_bytes(pickle.dumps({}))  # no photos are needed
        run_script(folder, str(INPUTS / "video-variants" / "build.py"), str(folder / "videos"))

    return made_once(tmp_path_factory, "inputs-videos", make)


def only(made: Path, name: str, folder: Path) -> Path:
    images = folder / "images"
    images.mkdir()
    shutil.copy(made / "videos" / name, images)
    return images


@pytest.mark.slow
@pytest.mark.parametrize("name", VIDEOS)
def test_the_frames_have_the_colours_of_sdr(made: Path, name: str, tmp_path: Path) -> None:
    """All frames but one at most, and one of them at 33.5 dB; the encoded SDR frames themselves are at 35."""
    prepared = prepare(only(made, name, tmp_path), None, tmp_path / "work", frames=150)
    assert len(prepared.photos) >= FRAMES - 1
    assert any(VIDEOS[name] in warning for warning in prepared.warnings)
    photo = prepared.photos[FRAMES // 2]
    with Image.open(photo.path) as frame:
        image = np.asarray(frame, float)
    truth = np.load(made / "vid.npy")[int(photo.path.stem.rpartition("_")[2])]
    assert image.shape == truth.shape
    assert 10 * math.log10(255**2 / ((image - truth) ** 2).mean()) > 33.5
    spread = [float((np.max(each, 2) - np.min(each, 2)).mean()) for each in (image, truth.astype(float))]
    assert spread[0] == pytest.approx(spread[1], rel=0.05)


@pytest.mark.slow
def test_the_cameras_are_those_of_the_frames(made: Path, tmp_path: Path) -> None:
    """Rotations after one common rotation, and square pixels from others in the file. Pixels taken for square turn
    cameras by 9 degrees; those at the ends of the path, which see least, are up to 0.3 off when all is right."""
    options = sfm.SfmOptions(stereo=False)
    scene = sfm.reconstruct(
        only(made, "anamorphic.mp4", tmp_path),
        None,
        tmp_path / "work",
        options,
        lambda stage, done, total, note: None,
        lambda: False,
    )
    assert len(scene.views) >= FRAMES - 1
    numbers = [int(view.image.stem.rpartition("_")[2]) for view in scene.views]
    rotations = np.stack([view.camera.viewmat[:3, :3] for view in scene.views])
    truth = np.stack([cameras()[number].viewmat[:3, :3] for number in numbers])
    u, _, v = np.linalg.svd(np.einsum("nji,njk->ik", rotations, truth))
    common = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    cosines = (np.einsum("nij,jk,nik->n", rotations, common, truth) - 1) / 2
    errors = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert np.median(errors) < 0.2
    assert errors.max() < 1.0
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (384, 288)
    assert camera.fx == pytest.approx(camera.fy, rel=0.01)
    assert camera.fx == pytest.approx(FOCAL_LENGTH, rel=0.02)
