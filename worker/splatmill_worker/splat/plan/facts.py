"""Facts about a scene, measured in seconds before the plan is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from splatmill_worker import memory
from splatmill_worker.images.lens import distortion
from splatmill_worker.scene import Scene
from splatmill_worker.splat.plan.light import Light, compared
from splatmill_worker.splat.plan.observations import MAX_POINTS, Observations
from splatmill_worker.splat.start.cells import cells_of
from splatmill_worker.splat.start.far_shell import shell_points
from splatmill_worker.splat.start.gaps import gap_points, gap_share
from splatmill_worker.splat.start.given_model import GivenModel
from splatmill_worker.splat.start.points import ENOUGH_POINTS
from splatmill_worker.splat.start.seeding import Seeds
from splatmill_worker.splat.start.sky import sky_share
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]

SOME_VIEWS = 50
"""Photos, evenly chosen, that are enough for a median over photos; up to twice as many are taken."""

LIBRARIES = 200 * 10**6
"""Resident pages of the files of COLMAP, torch and the other libraries, bytes."""


@dataclass(frozen=True)
class Speed:
    """Time of a training step.

    per_pixel: seconds per pixel of the photo.
    per_gaussian: seconds per Gaussian of the scene.
    """

    per_pixel: float
    per_gaussian: float

    def step(self, pixels: float, gaussians: float) -> float:
        """Seconds of a step with so many pixels and Gaussians."""
        return self.per_pixel * pixels + self.per_gaussian * gaussians


@dataclass(frozen=True)
class Geometry:
    """From where the points are seen; without stereo points.

    view_angle: median over points of the largest angle between two views of the point, degrees; None without points.
    distance_ratio: largest over smallest footprint of a pixel on the same point, 90th percentile over points.
    """

    view_angle: float | None
    distance_ratio: float


@dataclass(frozen=True)
class Coverage:
    """Which part of the photos' area shows points.

    sightings: median number of points that a photo shows.
    in_view: share of the points within a photo's frame, whether hidden or not: the median over photos, 0 to 1.
    sky_share: share of the photos' area that looks like sky and shows no point, 0 to 1.
    gap_share: share of the photos' area, sky excluded, with no point in or beside it, 0 to 1.
    gap_points: number of Gaussians that would fill the gaps.
    shell_points: number of Gaussians of the far shell.
    shell_distance: distance from the origin to the nearest Gaussian of the far shell, in units of the world.
    extent: radius around the cameras that holds nine points in ten, over the radius of the cameras.
    """

    sightings: float
    in_view: float
    sky_share: float
    gap_share: float
    gap_points: int
    shell_points: int
    shell_distance: float | None
    extent: float


@dataclass(frozen=True)
class Facts:
    """What is measured of a scene and of this machine before the plan is made. None: it cannot be measured here.

    Pixels are those of the training photos as they were loaded. Counts are of training photos unless the field says
    otherwise.

    views: number of training photos.
    held_out: number of held-out photos.
    width, height: median size of a photo, pixels.
    native_longest: longest side of the largest photo before it was loaded, pixels.
    points: number of points of the reconstruction, those of stereo included.
    source: where the cameras come from: "sfm", "colmap", "transforms", "blender" or "program".
    transparent: number of photos with transparent pixels.
    masked: number of photos with a mask.
    distorted: number of photos, held-out ones included, whose lens distortion was removed.
    halving_loss: median RMS difference between a photo and its half-size copy enlarged again, grey levels of 255.
    reprojection: median reprojection error, pixels; without stereo points.
    memory_available: memory that this process can still use, or free memory of the GPU for the gpu kernels, bytes.
    memory_used: memory of this process when the plan is made, bytes: libraries, what recovering the cameras leaves
        behind, and photos that are not in files.
    light: exposure and white balance of the photos; None where too few show the same points.
    geometry: None where it is not known which photos show which points.
    coverage: None without enough points, or where photos are transparent.
    speed: training time of this machine; None where it was not probed.
    start: the model that training starts from; None without one.
    lens_residual: largest displacement of a pixel by lens distortion, pixels.
    alignment: length of the mean viewing direction: 1 where all photos look the same way; of those that look level, 2
        over pi where they look evenly over half a turn, and 0 over a whole turn.
    hull_points: number of points on the visual hull of transparent photos; None where training does not start from one.
    no_hull: why the outlines of transparent photos give no hull to start from, a sentence; None where none was carved.
    no_points: why a posed scene has no points, a sentence; None where it has some.
    photo_bytes: size of all loaded photos, held-out ones included, with a mask or alpha for each; None: not known.
    photos_on_disk: whether they were loaded into files, since that is more than photos may take of the memory.
    seconds_left: what the job has left of the option `within` when the plan is made; None without that option.
    no_lpips: why LPIPS cannot be measured here, a sentence; None where it can.
    faces: number of photos, held-out ones included, that are faces of panoramas or of photos of wide lenses.
    """

    views: int
    held_out: int
    width: int
    height: int
    native_longest: int
    points: int
    source: str
    transparent: int
    masked: int
    distorted: int
    halving_loss: float
    reprojection: float | None
    memory_available: int
    memory_used: int = 0
    light: Light | None = None
    geometry: Geometry | None = None
    coverage: Coverage | None = None
    speed: Speed | None = None
    start: GivenModel | None = None
    lens_residual: float | None = None
    alignment: float | None = None
    no_points: str | None = None
    hull_points: int | None = None
    no_hull: str | None = None
    photo_bytes: int | None = None
    photos_on_disk: bool = False
    seconds_left: float | None = None
    no_lpips: str | None = None
    faces: int = 0

    @property
    def pixels(self) -> int:
        """Pixels of a photo."""
        return self.width * self.height

    def as_dict(self) -> dict[str, Any]:
        """The facts as plain values, for the report: those of light, geometry and coverage beside the others."""
        values = asdict(replace(self, light=None))
        del values["light"]
        absent: dict[str, dict[str, Any]] = {
            "geometry": {each.name: None for each in fields(Geometry)},
            "coverage": {each.name: None for each in fields(Coverage)} | {"gap_points": 0, "shell_points": 0},
        }
        for part, nothing in absent.items():
            values |= values.pop(part) or nothing
        return values | {
            "exposure_spread": self.light and self.light.spread,
            "tint_spread": self.light and self.light.tint_spread,
            "light_tail": self.light and self.light.tail,
            "light_error": self.light and self.light.error,
            "light_unseen": self.light and self.light.unseen,
        }


def measure(
    scene: Scene,
    views: Sequence[TrainingView],
    held_out: int,
    speed: Speed | None,
    tell: Callable[[str], None] = lambda part: None,
) -> tuple[Facts, Seeds | None]:
    """Facts of `scene`, and the seeds found in its photos; None where its points are too few, or photos transparent.

    views: the training photos, in the world of `scene`, of any origin and unit.
    held_out: number of held-out photos.
    speed: of this machine; None where it was not probed.
    tell: called with what is measured of the photos, before each part that takes seconds where there are many.
    """
    tell("comparing the light of the photos")
    sizes = np.array([[view.full.camera.width, view.full.camera.height] for view in views])
    width, height = (int(value) for value in np.median(sizes, axis=0))
    observations = Observations.of(scene, views)
    light = None if observations is None else compared(observations, views)
    survey = _coverage(scene, views, tell)
    facts = Facts(
        views=len(views),
        held_out=held_out,
        width=width,
        height=height,
        native_longest=max((max(view.camera.width, view.camera.height) for view in scene.views), default=0),
        points=len(scene.points),
        source=scene.source,
        transparent=sum(view.full.alpha is not None for view in views),
        masked=sum(view.full.mask is not None for view in views),
        distorted=sum(view.lens is not None for view in scene.views),
        faces=sum(view.face is not None for view in scene.views),
        halving_loss=float(np.median([halving_loss(view.full.rgb) for view in _some(views)])),
        light=light,
        geometry=None
        if observations is None
        else Geometry(observations.view_angle(_own_points(scene)), observations.distance_ratio()),
        coverage=None if survey is None else survey[0],
        alignment=_alignment(views),
        reprojection=_reprojection(scene, max(width, height)),
        lens_residual=_lens_residual(scene, max(width, height)),
        memory_available=0,
        speed=speed,
        no_points=scene.facts.get("no_points"),
    )
    del observations
    memory.return_freed()  # what was compared of many photos has left hundreds of megabytes of free pieces
    facts = replace(facts, memory_available=memory.available(), memory_used=memory.used() + LIBRARIES)
    return facts, None if survey is None else survey[1]


def halving_loss(rgb: torch.Tensor) -> float:
    """RMS difference between a photo uint8 [H, W, 3] and its half-size copy enlarged again, grey levels of 255."""
    planes = rgb.permute(2, 0, 1)[None].float()
    height, width = planes.shape[2:]
    if min(height, width) < 4:
        return math.inf
    small = torch.nn.functional.interpolate(planes, size=(height // 2, width // 2), mode="area")
    again = torch.nn.functional.interpolate(small, size=(height, width), mode="bicubic", align_corners=False)
    return float((again - planes).square().mean().sqrt())


def _alignment(views: Sequence[TrainingView]) -> float | None:
    """`Facts.alignment`; None without photos."""
    if not views:
        return None
    return float(np.linalg.norm(np.mean([view.full.camera.viewmat[2, :3] for view in views], axis=0)))


def _coverage(
    scene: Scene, views: Sequence[TrainingView], tell: Callable[[str], None]
) -> tuple[Coverage, Seeds] | None:
    if len(scene.points) < ENOUGH_POINTS or any(view.full.alpha is not None for view in views):
        return None
    tell("comparing the photos with the points")
    cells = cells_of(scene, views)
    shell, shell_colors = shell_points(cells, scene.points)
    tell("looking for gaps between the points")
    gaps = gap_points(cells)
    coverage = Coverage(
        sightings=float(np.median([len(grid.points) for grid in cells])),
        in_view=_in_view(scene, views),
        sky_share=sky_share(cells),
        gap_share=gap_share(cells),
        gap_points=len(gaps[0]),
        shell_points=len(shell),
        shell_distance=float(np.linalg.norm(shell, axis=1).min()) if len(shell) else None,
        extent=_extent(scene, views),
    )
    return coverage, Seeds((shell, shell_colors), gaps)


def _in_view(scene: Scene, views: Sequence[TrainingView]) -> float:
    """Median, over some photos, of the share of up to twice MAX_POINTS points within their frames."""
    points = scene.points[:: max(1, len(scene.points) // MAX_POINTS)]
    return float(np.median([view.full.camera.project(points).inside.mean() for view in _some(views)]))


def _some(views: Sequence[TrainingView]) -> Sequence[TrainingView]:
    """SOME_VIEWS photos, evenly chosen, and at most twice as many."""
    return views[:: max(1, len(views) // SOME_VIEWS)]


def _extent(scene: Scene, views: Sequence[TrainingView]) -> float:
    """Radius around the cameras' mean that holds nine points in ten, over the one that holds the cameras."""
    centers = np.array([view.full.camera.center for view in views])
    middle = centers.mean(axis=0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max())
    return float(np.percentile(np.linalg.norm(scene.points - middle, axis=1), 90)) / max(radius, 1e-12)


def _reprojection(scene: Scene, longest: int) -> float | None:
    """Median reprojection error in pixels of a photo that is `longest` long; None without any."""
    errors = np.zeros(0) if scene.point_errors is None else scene.point_errors[: _own_points(scene)]
    known = errors[np.isfinite(errors)]
    if not len(known):
        return None
    sizes = [view.camera if view.lens is None else view.lens for view in scene.views]
    own = float(np.median([max(size.width, size.height) for size in sizes]))
    return float(np.median(known)) * longest / own


def _own_points(scene: Scene) -> int:
    """Number of points that came with the cameras: the first ones. Those of stereo follow.

    Stereo points are left out of reprojection and view_angle: the plane sweep restricts their viewing angles and
    their depths.
    """
    return int(scene.facts.get("sparse_points", len(scene.points)))


def _lens_residual(scene: Scene, longest: int) -> float | None:
    """Largest displacement of a border pixel by lens distortion, in pixels of a photo that is `longest` long."""
    lenses = {view.lens for view in scene.views if view.lens is not None}
    moves = [distortion(lens) * longest / max(lens.width, lens.height) for lens in lenses]
    return max(moves, default=None)
