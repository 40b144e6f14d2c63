"""Lens distortion: the pinhole camera of the undistorted photo, and where its rays meet the photo.

Distortion is computed by COLMAP (`pycolmap.Camera`), so that all its camera models are supported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from splatmill.schema.quantities import counted
from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.image_circle import EDGE, Circle
from splatmill_worker.scene import Camera, Lens

Float = npt.NDArray[np.float64]

PANORAMA = "EQUIRECTANGULAR"
"""COLMAP's camera model of panoramas: columns are longitudes and rows latitudes, and z is in the middle."""

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
"""COLMAP's camera models without distortion."""

EQUIDISTANT_MODELS = (
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
"""COLMAP's camera models whose equations hold for what lies behind the camera, too."""

POLYNOMIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""COLMAP's camera models that are a pinhole when all distortion coefficients are zero; fisheye models are not."""

MIN_ZOOM, MAX_ZOOM = 0.4, 2.0
"""Bounds of the undistorted photo's focal length over the photo's: no pinhole camera shows all of a fisheye photo."""

MAX_HALF_ANGLE = 50.0
"""Degrees from the optical axis to the farthest side of the undistorted photo, at most. There a pinhole enlarges by 1 /
cos^2, 2.4 times: wider, its middle is coarse, and a Gaussian is no ellipse, as which it is projected."""

SIGHT_DIRECTIONS, SIGHT_STEPS = 32, 2000
"""Directions from the optical axis, and steps along each, in which the limits of what a lens sees are searched for."""

BORDER_SAMPLES = 64
"""Points on each side of the undistorted photo that must lie within the photo."""

ZOOM_STEPS = 800
"""Zooms tried between the bounds, 0.2 % apart."""

ASIDE = 0.01
"""Share of a ray's length across the axis up to which it counts as going aside or back: COLMAP divides by it."""

NOWHERE = -1e6
"""Pixel position of a ray that the lens does not see, far outside any photo."""


_TURNS = np.linspace(0.0, 2.0 * math.pi, SIGHT_DIRECTIONS, endpoint=False)
DIRECTIONS = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)
"""These directions, [SIGHT_DIRECTIONS,2]."""


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


def is_cut(lens: Lens) -> bool:
    """Whether the lens sees more than its pinhole camera shows."""
    return lens.model != PANORAMA and _zoom_of(lens).cut


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
        positions = distort(lens, _ahead(rays / zoom))
        low, high = positions.min(axis=0), positions.max(axis=0)
        # Up to half a pixel beyond the border, the nearest pixel is still one of the border.
        inside = bool(low.min() >= -0.5 and high[0] <= lens.width + 0.5 and high[1] <= lens.height + 0.5)
        return inside, float(np.linalg.norm(positions - (cx, cy), axis=1).max())

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
    """The angle from the axis, in radians, up to which the lens sees; infinite where its equations hold everywhere.

    Away from the axis, rays meet the photo farther and farther from the principal point. Where they do so no longer,
    the equations of the lens hold no more: a polynomial folds back, and would show again what is nearer to the axis.
    """
    camera = colmap_camera(lens)
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    most = math.pi if lens.model in EQUIDISTANT_MODELS else math.atan(1.0 / ASIDE)
    angles = np.linspace(0.0, most, SIGHT_STEPS + 1)[1:]
    # In units of the focal lengths, a lens puts a ray about in its own direction.
    bent = (_meet_all_round(camera, angles) - middle) / (camera.focal_length_x, camera.focal_length_y)
    away = (bent * DIRECTIONS).sum(axis=2)
    grows = (np.diff(away, axis=0, prepend=0.0) > 0.0).all(axis=1)
    folded = np.flatnonzero(~grows)
    if len(folded):
        # The largest distance lies at most a step before the last that grew.
        return float(angles[folded[0] - 2]) if folded[0] > 1 else 0.0
    return math.inf


def within(lens: Lens, circle: Circle) -> Lens:
    """The lens with the limit that a round picture sets; itself where that is none of a fisheye."""
    if lens.model == PANORAMA or lens.model in POLYNOMIAL_MODELS:
        return lens
    camera = colmap_camera(lens)
    middle = circle.x * lens.width, circle.y * lens.height
    radius = (1.0 - EDGE) * circle.radius * max(lens.width, lens.height)
    angles = np.linspace(0.0, min(sight(lens), math.pi), SIGHT_STEPS + 1)[1:-1]
    distances = np.linalg.norm(_meet_all_round(camera, angles) - middle, axis=2)
    beyond = np.flatnonzero(~(distances <= radius).any(axis=1))
    return replace(lens, limit=float(angles[beyond[0]])) if len(beyond) else lens


def _meet_all_round(camera: pycolmap.Camera, angles: Float) -> Float:
    """Pixel positions [n,SIGHT_DIRECTIONS,2] of rays at `angles` [n] from the axis, in all DIRECTIONS."""
    across = np.sin(angles)[:, None, None] * DIRECTIONS
    along = np.broadcast_to(np.cos(angles)[:, None, None], (*across.shape[:2], 1))
    return pixels_of(camera, np.concatenate([across, along], axis=2).reshape(-1, 3)).reshape(across.shape)


def remarks(lenses: Iterable[Lens | None], divided: Collection[Lens | None] = ()) -> list[str]:
    """Warnings for the user about the photos with these lenses, where the undistorted ones do not show all that a lens
    sees, or show more; the figures are those of the most common lens.

    divided: the lenses whose photos are divided into faces, which show all.
    """
    counts = Counter(lens for lens in lenses if lens is not None and lens.model != PANORAMA)
    said = []
    wide = Counter(
        {lens: count for lens, count in counts.items() if _zoom_of(lens).cut and lens not in divided}
    )
    if wide:
        lens = wide.most_common(1)[0][0]
        across = 2.0 * np.degrees(np.arctan(np.ptp(_border_rays(lens), axis=0) / _zoom_of(lens).zoom / 2.0))
        said.append(
            f"The lens of {_counted(wide)} sees more than a pinhole camera can show. The middle is trained on, "
            f"{across[0]:.0f} by {across[1]:.0f} degrees, and the rest of the photos is not used."
        )
    folded = Counter({lens: count for lens, count in counts.items() if _shows_fold(lens, lens in divided)})
    if folded:
        angle = math.degrees(sight(folded.most_common(1)[0][0]))
        said.append(
            f"The equations of the lens of {_counted(folded)} hold up to {angle:.0f} degrees from its axis. What lies "
            "beyond in the photos is not used."
        )
    return said


def _shows_fold(lens: Lens, divided: bool) -> bool:
    """Whether the undistorted photo, or a face where it is divided, shows what lies beyond the sight of the lens."""
    limit = sight(lens)
    if not divided:
        corner = float(np.linalg.norm(_border_rays(lens), axis=1).max())
        return math.atan(corner / _zoom_of(lens).zoom) > limit
    if math.isinf(limit) or lens.limit < limit:
        return False
    camera = colmap_camera(lens)
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    fold = np.linalg.norm(_meet_all_round(camera, np.array([limit]))[0] - middle, axis=1).max()
    corners = np.array([[0.0, 0.0], [lens.width, 0.0], [0.0, lens.height], [lens.width, lens.height]])
    return bool(np.linalg.norm(corners - middle, axis=1).max() > fold)


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
    pixels = pixels_of(camera, _ahead(rays))
    return float(np.linalg.norm(np.where(np.isfinite(pixels), pixels, NOWHERE) - frame, axis=1).max())


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
    """Pixel positions [n,2] on the distorted photo of rays [n,3] in the camera's frame, of any length.

    Rays that the lens does not see are put at NOWHERE.
    """
    pixels = pixels_of(colmap_camera(lens), rays)
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    pixels[angles > min(sight(lens), lens.limit)] = NOWHERE
    return np.where(np.isfinite(pixels), pixels, NOWHERE)


def _ahead(rays: Float) -> Float:
    """The rays (x, y, 1) [n,3] of (x, y), given as [n,2]."""
    return np.concatenate([rays, np.ones((len(rays), 1))], axis=1)


def pixels_of(camera: pycolmap.Camera, rays: Float) -> Float:
    """Pixel positions [n,2] of rays [n,3], by the equations of the lens; they may not be finite.

    COLMAP puts rays only that go ahead; where a lens is equidistant, the others are put by its equations as well.
    """
    pixels = np.array(camera.img_from_cam(rays), np.float64).reshape(-1, 2)
    aside = rays[:, 2] <= ASIDE * np.hypot(rays[:, 0], rays[:, 1])
    if camera.model.name in EQUIDISTANT_MODELS and aside.any():
        pixels[aside] = _meet_equidistant(camera, rays[aside])
    return pixels


def _meet_equidistant(camera: pycolmap.Camera, rays: Float) -> Float:
    """Pixel positions [n,2] of rays [n,3] on an equidistant lens: the angle from the axis, in the direction of the ray,
    then its distortion (COLMAP, src/colmap/sensor/models.h)."""
    radius = np.hypot(rays[:, 0], rays[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):  # straight behind is no direction
        bent = rays[:, :2] * (np.arctan2(radius, rays[:, 2]) / radius)[:, None]
    params = np.asarray(camera.params, np.float64)
    extra = params[camera.extra_params_idxs()].tolist()
    square = np.square(bent).sum(axis=1)
    moved = bent.copy()
    tangential: list[float] = []
    if camera.model.name == "THIN_PRISM_FISHEYE":
        extra, tangential = [extra[index] for index in (0, 1, 4, 5)], [extra[index] for index in (2, 3, 6, 7)]
    moved += (
        bent * sum(value * square**order for order, value in enumerate(extra, 1))[:, None] if extra else 0.0
    )
    if tangential:
        p1, p2, s1, s2 = tangential
        u, v = bent.T
        moved[:, 0] += 2.0 * p1 * u * v + p2 * (square + 2.0 * u * u) + s1 * square
        moved[:, 1] += 2.0 * p2 * u * v + p1 * (square + 2.0 * v * v) + s2 * square
    focal = camera.focal_length_x, camera.focal_length_y
    return np.asarray(moved * focal + (camera.principal_point_x, camera.principal_point_y))
