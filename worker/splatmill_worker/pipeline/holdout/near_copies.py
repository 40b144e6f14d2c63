"""Training photos that are near copies of held-out ones: of a burst, a bracket, or neighbouring frames of a slow video.

What makes a held-out photo a test is that it was taken from another place. So two photos are near copies when the scene
hardly shifts between their places, apart from how the camera was turned, and one shows most of what the other shows.
Photos are copies when their content is the same (`images.copies`); from one place, less of it suffices. A panorama
shows all directions; its shift is measured as an angle, of which a radian stands for the longer side of a photo.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from splatmill_worker.images.copies import SMALL_SIDE, SmallPicture, is_copy, small_grey
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.panoramas.faces import faces_of, is_panorama
from splatmill_worker.scene import Float, Scene, View, looked_at
from splatmill_worker.sfm.posed.same_bytes import ONE_CAMERA

PARALLAX = 0.003
"""Median shift of the scene between the places of two photos up to which they are near copies, as a share of the longer
side: a third of the least spacing of the frames that are taken of a video (`video.STILL`), and of what lies
between any two photos of captures around a thing."""

OVERLAP = 0.8
"""Share of what a held-out photo shows that its near copy shows as well."""

ONE_PLACE = PARALLAX / 3.0
"""Shift up to which two photos were taken from one place: a third of what slow steps leave between two frames."""

BESIDE = ONE_CAMERA
"""Shift up to which photos are compared by content: cameras that were recovered for each of two copies differ by less,
and round a thing that looks alike from several sides, photos differ by more."""

POINTS = 200
"""Points of the scene whose shift is measured, for each held-out photo."""

LEAST_POINTS = 8
"""Points below which the scene is taken to lie at the distance of what the cameras look at."""

NEARBY = 8.0
"""Factor by which photos may lie further apart than a shift of PARALLAX sideways needs, and are compared: a move along
the view shifts the middle of a photo little."""


def near_copies(
    scene: Scene, held_out: Sequence[View], training: Sequence[View], copies: Mapping[str, str]
) -> dict[str, str]:
    """The held-out photo of which each of some training photos is a near copy, by their names.

    copies: pairs of `same_photos`.
    """
    original_of: dict[str, str] = {}
    for view, other, _ in _pairs(scene, held_out, training, PARALLAX):
        original_of.setdefault(other.name, view.name)
    held, trained = ({view.name for view in views} for views in (held_out, training))
    for copy, original in copies.items():
        for one, another in ((copy, original), (original, copy)):
            if one in trained and another in held:
                original_of.setdefault(one, another)
    return original_of


def same_photos(scene: Scene) -> dict[str, str]:
    """The photo of which each of some photos is a copy, resized or brightened for example, by their names.

    Of all that are copies of one another, the original is the same: the one with the most pixels, and of those with as
    many the one with the fewest clipped ones.
    """
    ranked = sorted(scene.views, key=lambda view: (-view.camera.width * view.camera.height, view.name))
    rank = {view.name: index for index, view in enumerate(ranked)}
    small: dict[str, SmallPicture] = {}
    original_of: dict[str, str] = {}
    for view, other, shift in _pairs(scene, ranked, ranked, BESIDE):
        if rank[other.name] < rank[view.name] or view.name in original_of or other.name in original_of:
            continue
        for each in (view, other):
            if each.name not in small:
                small[each.name] = small_picture(each)
        if is_copy(small[other.name], small[view.name], one_place=shift <= ONE_PLACE):
            original_of[other.name] = view.name
    for original in dict.fromkeys(original_of.values()):
        alike = [original, *(name for name, of in original_of.items() if of == original)]
        best = min(alike, key=lambda name: (-small[name].pixels, small[name].clipped, name))
        if best != original:
            original_of |= dict.fromkeys(alike, best)
            del original_of[best]
    return dict(sorted(original_of.items()))


def small_picture(view: View) -> SmallPicture:
    """The photo at low resolution, as the view has it. Raises as `decoders.decode` does."""
    photo = decoders.decode(view.image, at_least=(SMALL_SIDE, SMALL_SIDE), upright=view.upright)
    return SmallPicture(view.name, view.camera.width, view.camera.height, small_grey(photo))


def _pairs(
    scene: Scene, views: Sequence[View], others: Sequence[View], most: float
) -> Iterator[tuple[View, View, float]]:
    """The pairs of one of `views` and one of `others` of which one shows most of the other, and the shift of the scene
    between their places, which is at most `most`."""
    if not scene.views:
        return
    centers = np.array([view.camera.center for view in others]).reshape(-1, 3)
    observed = _observed(scene)
    target = looked_at(scene.centers, np.array([view.camera.axis for view in scene.views]))

    def shown(view: View) -> Float:
        points = observed[view.name]
        if len(points) < LEAST_POINTS:
            distance = float(np.linalg.norm(target - view.camera.center))
            points = np.concatenate([_plane(part, distance) for part in faces_of(view)])
        return points[_inside(view, points)]

    points_of = {view.name: shown(view) for view in {id(view): view for view in (*views, *others)}.values()}
    for view in views:
        camera = view.camera
        points = points_of[view.name]
        if not len(points):
            continue
        if is_panorama(view):
            reach = NEARBY * most * float(np.median(np.linalg.norm(points - camera.center, axis=1)))
        else:
            depth = float(np.median(camera.project(points).depths))
            reach = NEARBY * most * max(camera.width, camera.height) / camera.fx * depth
        for index in np.flatnonzero(np.linalg.norm(centers - camera.center, axis=1) <= reach).tolist():
            other = others[index]
            if other is view or not (shift := _shift(view, other, points)) <= most:
                continue
            both = ((other, points), (view, points_of[other.name]))
            if any(len(cloud) and _inside(each, cloud).mean() >= OVERLAP for each, cloud in both):
                yield view, other, shift


def _shift(view: View, other: View, points: Float) -> float:
    """The median shift of points of one photo from its place to that of the other, as a share of the longer side."""
    camera = view.camera
    if is_panorama(view):
        rays, moved = (points - each.camera.center for each in (view, other))
        across = np.linalg.norm(np.cross(rays, moved), axis=1)
        return float(np.median(np.arctan2(across, (rays * moved).sum(axis=1))))
    here, there = camera.project(points), camera.moved_to(other.camera.center).project(points)
    shift = np.hypot(there.columns - here.columns, there.rows - here.rows) / max(camera.width, camera.height)
    shift[np.isnan(shift)] = np.inf  # behind the other place
    return float(np.median(shift))


def _inside(view: View, points: Float) -> npt.NDArray[np.bool_]:
    """Whether a photo shows each of some points [n]."""
    return np.ones(len(points), bool) if is_panorama(view) else view.camera.project(points).inside


def _observed(scene: Scene) -> dict[str, Float]:
    """Some of the points that each view observes, by its name; all points for each where tracks are not known."""
    if scene.point_views is None:
        return {view.name: scene.points[:: max(1, len(scene.points) // POINTS)] for view in scene.views}
    offsets, views = scene.point_views
    of_point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    result = {}
    order = np.argsort(views, kind="stable")
    starts = np.searchsorted(views[order], np.arange(len(scene.views) + 1))
    for index, view in enumerate(scene.views):
        own = of_point[order[starts[index] : starts[index + 1]]]
        result[view.name] = scene.points[own[:: max(1, len(own) // POINTS)]]
    return result


def _plane(view: View, depth: float) -> Float:
    """Points all over the photo at one depth."""
    camera = view.camera
    columns, rows = np.meshgrid(*(np.linspace(0.1, 0.9, 5) * side for side in (camera.width, camera.height)))
    return camera.unproject(columns.ravel(), rows.ravel(), np.full(columns.size, max(depth, 1e-6)))
