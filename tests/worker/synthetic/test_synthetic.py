"""The synthetic scene is ground truth: depths are exact, views agree with each other, and a seed fixes the bytes.

Does not prove that the scene is easy or hard for SfM or training; their own tests photograph it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import synthetic
from splatmill_worker.scene import Camera
from splatmill_worker.synthetic.ray_caster import Disc, Sphere

pytestmark = pytest.mark.slow


def points_of(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points [H*W, 3] behind the pixel centres of a depth image."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return camera.unproject(column.ravel(), row.ravel(), depth.ravel())


def test_depth_lands_on_the_surfaces() -> None:
    scene = synthetic.still_life(0)
    camera = synthetic.orbit(8, 64, 48)[2]
    _, depth = synthetic.photograph(scene, camera, samples=1)
    points = points_of(camera, depth.astype(np.float64))
    sphere = next(solid for solid in scene.solids if isinstance(solid, Sphere))
    discs = [solid for solid in scene.solids if isinstance(solid, Disc)]
    distances = [np.abs(np.linalg.norm(points, axis=1) - 40.0)]  # the dome
    distances += [np.abs(points[:, 2] - disc.z) for disc in discs]
    distances += [np.abs(np.linalg.norm(points - np.array(sphere.center), axis=1) - sphere.radius)]
    on_known = np.min(distances, axis=0) < 1e-3
    # What is left are boxes, the other spheres and the cylinder; all of them stand inside radius 1.6.
    others = points[~on_known]
    assert on_known.mean() > 0.5
    assert (np.linalg.norm(others[:, :2], axis=1) < 1.6).all()
    assert (others[:, 2] > -1e-3).all()


def test_two_views_agree_where_both_see_a_diffuse_point() -> None:
    scene = synthetic.still_life(0)
    first, second = synthetic.orbit(24, 160, 120)[:2]
    rgb_a, depth_a = synthetic.photograph(scene, first, samples=2)
    rgb_b, depth_b = synthetic.photograph(scene, second, samples=2)
    points = points_of(first, depth_a.astype(np.float64))
    table = np.abs(points[:, 2]) < 1e-3
    u, v, z, _ = second.project(points)
    inside = table & (u > 1) & (u < 159) & (v > 1) & (v < 119)
    row, column = v[inside].astype(int), u[inside].astype(int)
    visible = np.abs(depth_b[row, column] - z[inside]) < 0.05
    difference = np.abs(rgb_a.reshape(-1, 3)[inside].astype(float) - rgb_b[row, column]).mean(1)[visible]
    assert visible.sum() > 1000
    # Resampling at integer pixels costs a few levels; a wrong pose costs tens.
    assert np.median(difference) < 12


def test_a_capture_is_jpegs_with_exif_and_the_same_bytes_for_the_same_seed(tmp_path: Path) -> None:
    cameras = synthetic.capture(tmp_path / "a", count=2, width=96, height=64, seed=3)
    synthetic.capture(tmp_path / "b", count=2, width=96, height=64, seed=3)
    synthetic.capture(tmp_path / "c", count=2, width=96, height=64, seed=4)
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == sorted(cameras)
    for name in names:
        same = (tmp_path / "a" / name).read_bytes()
        assert same == (tmp_path / "b" / name).read_bytes()
        assert same != (tmp_path / "c" / name).read_bytes()
        with Image.open(tmp_path / "a" / name) as photo:
            assert photo.size == (96, 64)
            assert photo.getexif().get_ifd(0x8769)[0xA405] == round(35 * cameras[name].fx / 96)
