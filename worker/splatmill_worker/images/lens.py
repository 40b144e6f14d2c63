"""Lens distortion: the pinhole camera of the undistorted photo, and where its rays meet the photo.

Distortion is computed by COLMAP (`pycolmap.Camera`), so that all its camera models are supported.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Lens

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
"""COLMAP's camera models without distortion."""

POLYNOMIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""COLMAP's camera models that are a pinhole when all distortion coefficients are zero; fisheye models are not."""

MIN_ZOOM, MAX_ZOOM = 0.4, 2.0
"""Bounds of the undistorted photo's focal length over the photo's: no pinhole camera shows all of a fisheye photo."""

BORDER_SAMPLES = 64
"""Points on each side of the undistorted photo that must lie within the photo."""

ZOOM_STEPS = 800
"""Zooms tried between the bounds, 0.2 % apart."""

NOWHERE = -1e6
"""Pixel position of a ray that the lens does not see, far outside any photo."""


def lens_of(camera: pycolmap.Camera) -> Lens | None:
    """The lens of a COLMAP camera; None when it is a pinhole or its distortion is exactly zero."""
    name = camera.model.name
    params = np.asarray(camera.params, np.float64)
    if name in PINHOLE_MODELS or (name in POLYNOMIAL_MODELS and not params[camera.extra_params_idxs()].any()):
        return None
    return Lens(name, tuple(params.tolist()), camera.width, camera.height)


def pinhole(lens: Lens, viewmat: npt.NDArray[np.float64]) -> Camera:
    """The pinhole camera of the undistorted photo, with the size and principal point of the photo.

    Its focal length is the smallest, within the bounds of the zoom, for which the whole undistorted photo lies within
    the photo. At the bounds, `load_view` masks the pixels that the photo does not cover.
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
        """Whether the border at this zoom lies within the photo, and its largest distance from the principal point."""
        seen = distort(camera, rays / zoom)
        low, high = seen.min(axis=0), seen.max(axis=0)
        # Up to half a pixel beyond the border, the nearest pixel is still one of the border.
        inside = bool(low.min() >= -0.5 and high[0] <= lens.width + 0.5 and high[1] <= lens.height + 0.5)
        return inside, float(np.linalg.norm(seen - (cx, cy), axis=1).max())

    # From the narrowest view to wider ones: far from the centre a distortion polynomial is no longer monotonic, and a
    # border there would be mapped back into the photo.
    zoom, before = MAX_ZOOM, 0.0
    for wider in np.geomspace(MAX_ZOOM, MIN_ZOOM, ZOOM_STEPS):
        inside, distance = reach(float(wider))
        if not inside or distance <= before:
            break
        zoom, before = float(wider), distance
    return plain.fx, plain.fy, cx, cy, zoom


@lru_cache(maxsize=4096)
def distortion(lens: Lens) -> float:
    """The largest distance, in pixels, by which the lens moves a pixel on the photo's border."""
    camera = colmap_camera(lens)
    corner = np.array([[0.0, 0.0], [lens.width, 0.0], [0.0, lens.height], [lens.width, lens.height]])
    frame = np.concatenate([corner, (corner + corner[[1, 3, 0, 2]]) / 2])
    rays = np.stack(without_distortion(camera).normalized(frame[:, 0], frame[:, 1]), axis=1)
    seen = distort(camera, rays)
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


def distort(camera: pycolmap.Camera, rays: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Pixel positions [n,2] on the distorted photo of rays (x, y, 1), given as [n,2].

    Rays that the lens does not see are put at NOWHERE.
    """
    ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels = np.asarray(camera.img_from_cam(ahead), np.float64)
    return np.where(np.isfinite(pixels), pixels, NOWHERE)
