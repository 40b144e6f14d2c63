"""Lens distortion: the pinhole camera of the undistorted photo, and where its rays meet the photo.

Distortion is computed by COLMAP (`pycolmap.Camera`), so that all its camera models are supported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatmill.schema.quantities import counted
from splatmill_worker.colmap import pycolmap
from splatmill_worker.scene import Camera, Lens

Float = npt.NDArray[np.float64]

PANORAMA = "EQUIRECTANGULAR"
"""COLMAP's camera model of panoramas: columns are longitudes and rows latitudes, and z is in the middle."""

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
"""COLMAP's camera models without distortion."""

POLYNOMIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""COLMAP's camera models that are a pinhole when all distortion coefficients are zero; fisheye models are not."""

MIN_ZOOM, MAX_ZOOM = 0.4, 2.0
"""Bounds of the undistorted photo's focal length over the photo's: no pinhole camera shows all of a fisheye photo."""

MAX_HALF_ANGLE = 50.0
"""Degrees from the optical axis to the farthest side of the undistorted photo, at most. There a pinhole enlarges by 1 /
cos^2, 2.4 times: wider, its middle is coarse, and a Gaussian is no ellipse, as which it is projected."""

SIGHT_DIRECTIONS, SIGHT_STEPS = 32, 2000
"""Directions from the optical axis, and steps along each, in which the limit of what a lens sees is searched for."""

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

    Its focal length is the smallest, within the bounds of the zoom and of MAX_HALF_ANGLE, for which the whole
    undistorted photo lies within the photo. At the bounds, `load_view` masks the pixels that the photo does not cover.
    """
    plain = without_distortion(colmap_camera(lens))
    zoom = _zoom_of(lens).zoom
    return Camera(lens.width, lens.height, plain.fx * zoom, plain.fy * zoom, plain.cx, plain.cy, viewmat)


class _Zoom(NamedTuple):
    """The focal length of the undistorted photo over the photo's, and whether the lens sees more than it shows."""

    zoom: float
    cut: bool


@lru_cache(maxsize=4096)
def _zoom_of(lens: Lens) -> _Zoom:
    cx, cy = (lens.params[index] for index in colmap_camera(lens).principal_point_idxs())
    rays = _border_rays(lens)
    least = _least_zoom(lens)

    def reach(zoom: float) -> tuple[bool, float]:
        """Whether the border at this zoom lies within the photo, and its largest distance from the principal point."""
        seen = distort(lens, rays / zoom)
        low, high = seen.min(axis=0), seen.max(axis=0)
        # Up to half a pixel beyond the border, the nearest pixel is still one of the border.
        inside = bool(low.min() >= -0.5 and high[0] <= lens.width + 0.5 and high[1] <= lens.height + 0.5)
        return inside, float(np.linalg.norm(seen - (cx, cy), axis=1).max())

    # From the narrowest view to wider ones: far from the centre a distortion polynomial is no longer monotonic, and a
    # border there would be mapped back into the photo.
    zooms = [float(zoom) for zoom in np.geomspace(MAX_ZOOM, MIN_ZOOM, ZOOM_STEPS) if zoom > least] + [least]
    zoom, before = zooms[0], 0.0
    for wider in zooms:
        inside, distance = reach(wider)
        if not inside or distance <= before:
            return _Zoom(zoom, cut=False)
        zoom, before = wider, distance
    return _Zoom(zoom, cut=True)


def _border_rays(lens: Lens) -> Float:
    """Rays (x, y, 1) through the border of the photo of a pinhole with the focal lengths of the lens, [n,2]."""
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
    return np.stack(without_distortion(colmap_camera(lens)).normalized(frame[:, 0], frame[:, 1]), axis=1)


def _least_zoom(lens: Lens) -> float:
    """The zoom of the widest undistorted photo. A lens that is a pinhole but for its distortion keeps its own width."""
    widest = float(np.abs(_border_rays(lens)).max()) / math.tan(math.radians(MAX_HALF_ANGLE))
    return max(MIN_ZOOM, min(1.0, widest) if lens.model in POLYNOMIAL_MODELS else widest)


@lru_cache(maxsize=4096)
def sight(lens: Lens) -> float:
    """The length of (x, y) up to which the lens sees rays (x, y, 1); infinite where that is all of the photo.

    Away from the axis, rays meet the photo farther and farther from the principal point. Where they do so no longer,
    the equations of the lens hold no more: a polynomial folds back, and would show again what is nearer to the axis.
    """
    camera = colmap_camera(lens)
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    farthest = float(np.linalg.norm(_border_rays(lens), axis=1).max()) / _least_zoom(lens)
    lengths = np.linspace(0.0, farthest, SIGHT_STEPS + 1)[1:]
    angles = np.linspace(0.0, 2.0 * math.pi, SIGHT_DIRECTIONS, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rays = lengths[:, None, None] * directions
    # In units of the focal lengths, a lens puts a ray about in its own direction.
    bent = (_meet(camera, rays.reshape(-1, 2)) - middle) / (camera.focal_length_x, camera.focal_length_y)
    away = (bent.reshape(rays.shape) * directions).sum(axis=2)
    grows = (np.diff(away, axis=0, prepend=0.0) > 0.0).all(axis=1)
    folded = np.flatnonzero(~grows)
    # The largest distance lies at most a step before the last that grew.
    return (float(lengths[folded[0] - 2]) if folded[0] > 1 else 0.0) if len(folded) else math.inf


def remarks(lenses: Iterable[Lens | None]) -> list[str]:
    """Warnings for the user about the photos with these lenses, where the undistorted ones do not show all that a lens
    sees, or show more; the figures are those of the most common lens."""
    counts = Counter(lens for lens in lenses if lens is not None and lens.model != PANORAMA)
    said = []
    wide = Counter({lens: count for lens, count in counts.items() if _zoom_of(lens).cut})
    if wide:
        lens = wide.most_common(1)[0][0]
        across = 2.0 * np.degrees(np.arctan(np.ptp(_border_rays(lens), axis=0) / _zoom_of(lens).zoom / 2.0))
        said.append(
            f"The lens of {_counted(wide)} sees more than a pinhole camera can show. The middle is trained on, "
            f"{across[0]:.0f} by {across[1]:.0f} degrees, and the rest of the photos is not used."
        )
    corner = {lens: np.linalg.norm(_border_rays(lens), axis=1).max() / _zoom_of(lens).zoom for lens in counts}
    folded = Counter({lens: count for lens, count in counts.items() if corner[lens] > sight(lens)})
    if folded:
        angle = math.degrees(math.atan(sight(folded.most_common(1)[0][0])))
        said.append(
            f"The equations of the lens of {_counted(folded)} hold up to {angle:.0f} degrees from its axis. What lies "
            "beyond in the photos is not used."
        )
    return said


def _counted(lenses: Counter[Lens]) -> str:
    photos = counted(lenses.total(), "photo")
    return f"{photos} ({', '.join(sorted({lens.model for lens in lenses}))})"


@lru_cache(maxsize=4096)
def distortion(lens: Lens) -> float:
    """The largest distance, in pixels, by which the lens moves a pixel on the photo's border."""
    camera = colmap_camera(lens)
    corner = np.array([[0.0, 0.0], [lens.width, 0.0], [0.0, lens.height], [lens.width, lens.height]])
    frame = np.concatenate([corner, (corner + corner[[1, 3, 0, 2]]) / 2])
    rays = np.stack(without_distortion(camera).normalized(frame[:, 0], frame[:, 1]), axis=1)
    seen = _meet(camera, rays)
    return float(np.linalg.norm(np.where(np.isfinite(seen), seen, NOWHERE) - frame, axis=1).max())


def without_distortion(camera: pycolmap.Camera) -> Camera:
    """The pinhole camera with the size, focal lengths and principal point of a COLMAP camera, at the origin.

    Of a panorama, it is one that shows the middle as large; `faces` replaces it.
    """
    if camera.is_spherical():
        focal, middle = camera.width / (2.0 * math.pi), (camera.width / 2.0, camera.height / 2.0)
        return Camera(camera.width, camera.height, focal, focal, *middle, np.eye(4))
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


def distort(lens: Lens, rays: Float) -> Float:
    """Pixel positions [n,2] on the distorted photo of rays (x, y, 1), given as [n,2].

    Rays that the lens does not see are put at NOWHERE.
    """
    pixels = _meet(colmap_camera(lens), rays)
    pixels[np.linalg.norm(rays, axis=1) > sight(lens)] = NOWHERE
    return np.where(np.isfinite(pixels), pixels, NOWHERE)


def _meet(camera: pycolmap.Camera, rays: Float) -> Float:
    """Pixel positions [n,2] of rays (x, y, 1), given as [n,2], by the equations of the lens; they may not be finite."""
    ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return np.array(camera.img_from_cam(ahead), np.float64)
