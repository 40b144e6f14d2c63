"""Proves that a point has the mean colour of the photos that observe it, where they observe it.

Does not prove that the mean is the best choice where photos differ in their light.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, View
from splatmill_worker.sfm.colors import color_points

WIDTH, HEIGHT = 40, 30
OWN = np.array([9, 8, 7], np.uint8)


def test_points_have_the_mean_colour_of_the_photos_that_observe_them(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    pixels = random.integers(0, 256, (3, HEIGHT, WIDTH, 3), np.uint8)
    keypoints = random.uniform([0.0, 0.0], [WIDTH, HEIGHT], (3, 20, 2))
    keypoints[2, 4] = WIDTH + 3.0, -2.0  # a lens may put it beside the photo; the nearest pixel counts
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[30.0, 20.0, 15.0]
        )
    )
    views = {}
    for number in range(3):
        path = tmp_path / f"{number}.png"
        Image.fromarray(pixels[number]).save(path)
        image = pycolmap.Image(name=path.name, keypoints=keypoints[number], camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        views[number + 1] = View(path.name, Camera(WIDTH, HEIGHT, 30.0, 30.0, 20.0, 15.0, np.eye(4)), path)
    # Features of the photos 0, 1 and 2 by point: of all three, of two, of one that shows it twice.
    tracks = [[(0, 1), (1, 2), (2, 4)], [(1, 5), (2, 6)], [(1, 7), (1, 8), (2, 9)]]
    points = [
        model.add_point3D(
            np.zeros(3), pycolmap.Track([pycolmap.TrackElement(p + 1, f) for p, f in track]), OWN
        )
        for track in tracks
    ]
    del views[1]  # the first photo is not read
    done: list[int] = []
    with ThreadPoolExecutor(2) as pool:
        color_points(model, views, pool, done.append)
    assert done == [1, 2]
    for point, track in zip(points, tracks, strict=True):
        colors = [
            pixels[p, clipped(y, HEIGHT), clipped(x, WIDTH)]
            for p, f in track
            if p
            for x, y in [keypoints[p, f]]
        ]
        np.testing.assert_array_equal(model.points3D[point].color, np.round(np.mean(colors, axis=0)))


def test_a_point_that_no_photo_shows_keeps_its_colour(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    point = model.add_point3D(np.zeros(3), pycolmap.Track(), OWN)
    with ThreadPoolExecutor(1) as pool:
        color_points(model, {}, pool, lambda done: None)
    np.testing.assert_array_equal(model.points3D[point].color, OWN)


def clipped(at: float, size: int) -> int:
    """The pixel of a place along one side."""
    return min(max(int(at), 0), size - 1)
