"""From the lens a photo was taken with to the pinhole camera the trainer renders with.

Distortion itself is COLMAP's (`pycolmap.Camera`), so every camera model it knows is undistorted here.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Lens

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
# With all extra parameters 0 these are a pinhole; a fisheye model is not.
POLYNOMIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
# The zoom of the undistorted photo is kept in these bounds: a fisheye photo has no pinhole picture of all it saw.
MIN_ZOOM, MAX_ZOOM = 0.4, 2.0
BORDER_SAMPLES = 64
ZOOM_STEPS = 800  # 0.2 % each


def lens_of(camera: pycolmap.Camera) -> Lens | None:
    """The lens of a COLMAP camera; None where it is a plain pinhole or its distortion is exactly zero."""
    name = camera.model.name
    params = np.asarray(camera.params, np.float64)
    if name in PINHOLE_MODELS or (name in POLYNOMIAL_MODELS and not params[camera.extra_params_idxs()].any()):
        return None
    return Lens(name, tuple(params.tolist()), camera.width, camera.height)


def pinhole(lens: Lens, viewmat: npt.NDArray[np.float64]) -> Camera:
    """The pinhole camera of the undistorted photo: its centre stays, its focal length is zoomed.

    The zoom is the smallest for which the frame of the undistorted photo lies inside the photo, within
    [0.4, 2]; where a lens goes beyond that, the pixels without a source are masked by `load_views`.
    """
    fx, fy, cx, cy, zoom = _pinhole_of(lens)
    return Camera(lens.width, lens.height, fx * zoom, fy * zoom, cx, cy, viewmat)


@lru_cache(maxsize=4096)
def _pinhole_of(lens: Lens) -> tuple[float, float, float, float, float]:
    camera = colmap_camera(lens)
    plain = without_distortion(camera)
    cx, cy = plain.cx, plain.cy
    t = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    x, y = t * lens.width, t * lens.height
    frame = np.concatenate(
        [
            np.stack([x, np.zeros_like(x)], 1),
            np.stack([x, np.full_like(x, lens.height)], 1),
            np.stack([np.zeros_like(y), y], 1),
            np.stack([np.full_like(y, lens.width), y], 1),
        ]
    )
    rays = np.stack(plain.normalized(frame[:, 0], frame[:, 1]), axis=1)

    def reach(zoom: float) -> tuple[bool, float]:
        """Whether the frame at this zoom lies inside the photo, and how far from the centre its corners land."""
        seen = project(camera, rays / zoom)
        low, high = seen.min(axis=0), seen.max(axis=0)
        # Half a pixel beyond the border is still served by the border pixels.
        inside = bool(low.min() >= -0.5 and high[0] <= lens.width + 0.5 and high[1] <= lens.height + 0.5)
        return inside, float(np.linalg.norm(seen - (cx, cy), axis=1).max())

    # From the narrowest view outwards, since far from the centre a distortion polynomial folds back into the
    # photo and a frame there would look as if it fitted.
    zoom, before = MAX_ZOOM, 0.0
    for wider in np.geomspace(MAX_ZOOM, MIN_ZOOM, ZOOM_STEPS):
        inside, distance = reach(float(wider))
        if not inside or distance <= before:
            break
        zoom, before = float(wider), distance
    return plain.fx, plain.fy, cx, cy, zoom


@lru_cache(maxsize=4096)
def distortion(lens: Lens) -> float:
    """The farthest that the lens moves a pixel on the photo's border from where a pinhole would have put it."""
    camera = colmap_camera(lens)
    corner = np.array([[0.0, 0.0], [lens.width, 0.0], [0.0, lens.height], [lens.width, lens.height]])
    frame = np.concatenate([corner, (corner + corner[[1, 3, 0, 2]]) / 2])
    rays = np.stack(without_distortion(camera).normalized(frame[:, 0], frame[:, 1]), axis=1)
    seen = project(camera, rays)
    return float(np.linalg.norm(seen - frame, axis=1).max())


def without_distortion(camera: pycolmap.Camera) -> Camera:
    """The pinhole camera with the size, focal lengths and principal point of a COLMAP camera, at the origin."""
    return Camera(
        camera.width,
        camera.height,
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
        np.eye(4),
    )


def colmap_camera(lens: Lens) -> pycolmap.Camera:
    """The COLMAP camera with this lens."""
    return pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))


def project(camera: pycolmap.Camera, rays: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixels [n,2] where rays (x, y, 1) [n,2] meet the photo; far outside the photo where the lens sees nothing."""
    ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels = np.asarray(camera.img_from_cam(ahead), np.float64)
    return np.where(np.isfinite(pixels), pixels, -1e6)
