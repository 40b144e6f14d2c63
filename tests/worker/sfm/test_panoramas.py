"""Proves that the cameras of panoramas are recovered, alone and beside ordinary photos; that panoramas from one place
are refused by name; and that what they see is divided among their faces.

The still life in a room is photographed by the ray caster, whose cameras are the truth. Not proven: how well it trains.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import SfmFailed
from splatmill_worker.images.panoramas.faces import joined
from splatmill_worker.scene import Float, Scene, viewmat_of
from splatmill_worker.sfm import SfmOptions, reconstruct
from splatmill_worker.synthetic import look_at
from splatmill_worker.synthetic.ray_caster import picture
from tests.support import panoramas
from tests.support.made_once import made_once

pytestmark = pytest.mark.slow

COUNT, WIDTH = 10, 640


@pytest.fixture(scope="session")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Panoramas on a path round the table."""

    def make(folder: Path) -> None:
        panoramas.write(folder, panoramas.walk(COUNT), WIDTH, samples=1)

    return made_once(tmp_path_factory, "panoramas", make)


def poses_of(images: Path) -> dict[str, Float]:
    return dict(zip(sorted(path.name for path in images.iterdir()), panoramas.walk(COUNT), strict=True))


def recovered(images: Path, work: Path, stereo: bool = False) -> Scene:
    return reconstruct(images, None, work, SfmOptions(stereo=stereo), lambda *_: None, lambda: False)


def errors(scene: Scene, truth: dict[str, Float]) -> tuple[float, float]:
    """Largest angle in degrees and distance of the cameras from the truth, after a similarity; distances over the
    radius of the cameras."""
    views = [view for view in joined(scene).views if view.name in truth]
    poses = [truth[view.name] for view in views]
    centers = np.array([view.camera.center for view in views])
    expected = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    similarity = pycolmap.estimate_sim3d(centers, expected)
    assert similarity is not None
    off = np.linalg.norm(np.array([similarity * center for center in centers]) - expected, axis=1)
    turn = similarity.rotation.matrix()
    angles = [
        np.degrees(
            np.arccos(
                np.clip((np.trace(view.camera.viewmat[:3, :3] @ turn.T @ pose[:3, :3].T) - 1) / 2, -1, 1)
            )
        )
        for view, pose in zip(views, poses, strict=True)
    ]
    radius = np.linalg.norm(expected - expected.mean(axis=0), axis=1).max()
    return float(max(angles)), float(off.max() / radius)


def test_cameras_of_panoramas_are_recovered(walked: Path, tmp_path: Path) -> None:
    scene = recovered(walked, tmp_path, stereo=True)
    assert len(scene.views) == 6 * COUNT
    assert scene.facts["photos"] == scene.facts["registered"] == COUNT
    angle, distance = errors(scene, poses_of(walked))
    assert angle < 0.1
    assert distance < 0.005
    assert any("60 faces" in note for note in scene.notes)
    assert scene.point_views is not None
    of_point = np.repeat(np.arange(len(scene.points)), np.diff(scene.point_views.offsets))
    for index, view in enumerate(scene.views):
        own = of_point[scene.point_views.views == index]
        assert view.camera.project(scene.points[own]).inside.all()


def test_panoramas_and_ordinary_photos_are_used_together(walked: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    truth = poses_of(walked)
    for name in truth:
        (images / name).write_bytes((walked / name).read_bytes())
    for number in range(4):
        angle = 0.4 * number
        eye = 2.6 * np.array([np.cos(angle), np.sin(angle), 0.35])
        camera = look_at(eye, np.array([0.0, 0.0, 0.2]), 480, 360, 400.0)
        name = f"plain_{number}.jpg"
        Image.fromarray(picture(panoramas.room(), camera, 1)).save(images / name, quality=95)
        truth[name] = camera.viewmat
    scene = recovered(images, tmp_path)
    assert {view.photo for view in scene.views} == set(truth)
    angle, distance = errors(scene, truth)
    assert angle < 0.3
    assert distance < 0.02


def test_panoramas_of_one_place_are_refused_by_name(tmp_path: Path) -> None:
    eye = np.array([2.0, 1.0, 0.6])
    poses = [viewmat_of(pose[:3, :3], eye) for pose in panoramas.walk(4)]
    panoramas.write(tmp_path / "images", poses, 512, samples=1)
    with pytest.raises(SfmFailed, match="turned without moving") as error:
        recovered(tmp_path / "images", tmp_path)
    assert error.value.code == "sfm_no_parallax"
    assert "Take a step between any two photos" in (error.value.advice or "")


def test_a_single_panorama_is_too_few(tmp_path: Path) -> None:
    panoramas.striped(tmp_path / "images/0.jpg", panoramas.gpano(ProjectionType="equirectangular"))
    with pytest.raises(SfmFailed) as error:
        recovered(tmp_path / "images", tmp_path)
    assert error.value.code == "too_few_images"
