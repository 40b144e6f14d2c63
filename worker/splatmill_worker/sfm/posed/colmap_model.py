"""Scenes from COLMAP models: from files, text or binary, or from memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.colmap import pycolmap
from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.lens import PANORAMA, lens_of, pinhole, without_distortion
from splatmill_worker.readers.colmap_files import place
from splatmill_worker.scene import Camera, Lens, PointViews, Scene, Source, View
from splatmill_worker.sfm.posed import model_files
from splatmill_worker.sfm.posed.encodings import decoded
from splatmill_worker.sfm.posed.files import ImageFiles, alternatives, instead, missing, none_usable
from splatmill_worker.sfm.posed.model_files import GivenImage, GivenModel, ModelPoints
from splatmill_worker.sfm.posed.one_camera import one_for_each

Integers = npt.NDArray[np.int64]

MOST_MODELS = 50
"""Models of one capture that are read; COLMAP writes as many at most."""

MAX_ASPECT_ERROR = 0.02
"""Relative difference of aspect ratios up to which a camera fits a photo: sizes are rounded to whole pixels."""


def load(folder: Path, files: ImageFiles, notes: tuple[str, ...] = ()) -> Scene:
    """The scene of the model in `folder`, with its photos among `files`.

    Cameras are scaled to the size of the files. Raises ValueError when the model cannot be read, and when none of its
    photos is among the files.
    """
    model, remarks = decoded(model_files.read(folder), files)
    return _with(scene_of_given(model, files, notes), remarks)


def load_largest(folders: Sequence[Path], files: ImageFiles, notes: tuple[str, ...] = ()) -> Scene:
    """The scene of the model with the most photos among `files`, of several models of one capture.

    COLMAP writes a model for each set of photos that it could not join with the others; their worlds differ, so that
    one is used, and a warning says which. Raises ValueError as `load` does, for the first model where none can be read.
    """
    if len(folders) == 1:
        return load(folders[0], files, notes)
    if len(folders) > MOST_MODELS:
        raise ValueError(
            f"The capture has {len(folders)} COLMAP models; at most {MOST_MODELS} are read. Give one of them."
        )
    best: tuple[int, Path, GivenModel, tuple[str, ...]] | None = None
    said: dict[Path, str] = {}
    faults: list[ValueError] = []
    for folder in folders:
        try:
            model, remarks = decoded(model_files.read(folder), files)
        except ValueError as error:
            faults.append(error)
            said[folder] = f"{_shown(folder)} is not used: {error}"
            continue
        count = len({path for image in model.images.values() if (path := _path(files, image.name))})
        said[folder] = f"{_shown(folder)} has {count} of the photos."
        if best is None or count > best[0]:
            best = count, folder, model, remarks
    if best is None:
        raise faults[0]
    count, folder, model, remarks = best
    scene = _with(scene_of_given(model, files, notes), remarks)
    others = (sentence for other, sentence in said.items() if other != folder)
    which = f"Of {len(folders)} COLMAP models, {_shown(folder)} is used, with {count} photos, because it has the most."
    return replace(scene, warnings=(*scene.warnings, " ".join((which, *others))))


def _path(files: ImageFiles, name: str) -> Path | None:
    photo = files.photo(name)
    return None if photo is None else photo[1]


def _shown(folder: Path) -> str:
    return place(folder) or "the one beside the photos"


def _with(scene: Scene, warnings: tuple[str, ...]) -> Scene:
    return replace(scene, warnings=(*scene.warnings, *warnings))


def scene_of_given(
    model: GivenModel, files: ImageFiles, notes: tuple[str, ...] = (), *, source: Source = "colmap"
) -> Scene:
    """The scene of a model that was read; see `load`."""
    what = f"{model.what[0].upper()}{model.what[1:]}"
    views: dict[int, View] = {}
    lacking: list[tuple[str, str]] = []
    unusable: dict[Path, tuple[str, str]] = {}
    for image_id, image in sorted(model.images.items(), key=lambda item: item[1].name):
        photo = files.photo(image.name)
        if photo is None:
            lacking.append((image.name, missing(image.name, files, f"{model.what} has a camera for it")))
            continue
        name, path = photo
        try:
            views[image_id] = _view(image, name, path, files.mask(name))
        except UnusablePicture as error:
            unusable[path] = (name, error.reason)
    if not views and unusable:
        raise none_usable(list(unusable.values()))
    if not views:
        if not lacking:
            raise ValueError(f"{what} has no registered photo. Give one that has, or leave it out.")
        several = alternatives(first := lacking[0][0], files)
        raise ValueError(
            f"{what} names {len(lacking)} photos (such as {first!r}), and the capture has "
            + (f"several of this name: {several}." if several else f"none of them{instead(files)}.")
            + " Give the photos the names that the model uses."
        )
    copies, copy_warnings = files.copies({view.image for view in views.values()})
    faulty = {photo[1]: fault for name, fault in model.faulty if (photo := files.photo(name)) is not None}
    views, contradictory = one_for_each(views, lambda key: f"image {key} ({model.images[key].name})")
    faulty |= {files.photos[name]: fault for name, fault in contradictory}
    used = {view.image for view in views.values()}
    without = [
        (name, faulty.get(path, f"{model.what} has no camera for it"))
        for name, path in files.photos.items()
        if path not in used and path not in copies and path not in unusable
    ]
    left_out = (*lacking, *unusable.values(), *without)
    scene = scene_of(model.points, views, source=source, left_out=left_out, notes=notes)
    return replace(scene, warnings=copy_warnings)


def _view(image: GivenImage, name: str, path: Path, mask: Path | None) -> View:
    """The view of a given photo; see `fit_to_file`. Without a size, both orientations of the photo are tried."""
    if isinstance(image.camera, pycolmap.Camera):
        return fit_to_file(camera_and_lens(image.camera, image.viewmat), name, path, mask)
    stored, upright, _ = decoders.sizes(path, name)
    view, *other = (
        fit_to_file(camera_and_lens(image.camera(*size), image.viewmat), name, path, mask)
        for size in dict.fromkeys((stored, upright))
    )
    return replace(view, other=other[0]) if other else view


def camera_and_lens(camera: pycolmap.Camera, viewmat: npt.NDArray[np.float64]) -> tuple[Camera, Lens | None]:
    """The pinhole camera of the undistorted photo, and the lens of the photo itself; None for a pinhole.

    A panorama has the camera of `without_distortion` until `faces.cut` divides it.
    """
    lens = lens_of(camera)
    if lens is not None and lens.model != PANORAMA:
        return pinhole(lens, viewmat), lens
    return replace(without_distortion(camera), viewmat=viewmat), lens


def fit_to_file(posed: tuple[Camera, Lens | None], name: str, path: Path, mask: Path | None) -> View:
    """A view with its camera at the size of the file at `path`.

    Whether the camera describes the photo before or after its EXIF orientation is applied depends on the tool that
    made it, and is decided by the aspect ratio. Where both fit, the view is that of the photo as stored, and `other`
    that of the upright one, between which `orientation.decided` chooses. Raises UnusablePicture where neither fits.
    """
    camera, lens = posed
    if mask is not None and (reason := decoders.ended(mask)) is not None:
        raise UnusablePicture("decoder_ended", name, f"of its mask: {reason}")
    stored, upright, orientation = decoders.sizes(path, name)

    def fits(size: tuple[int, int]) -> bool:
        # Reduced sizes are rounded to whole pixels, which changes the aspect ratio of small photos the most.
        error = abs(size[0] / size[1] * camera.height / camera.width - 1.0)
        return error < MAX_ASPECT_ERROR + 2.0 / min(size)

    if not fits(stored) and not fits(upright):
        raise UnusablePicture(
            "poses_invalid",
            name,
            f"it has {upright[0]} x {upright[1]} pixels, another shape than the {camera.width} x {camera.height} of "
            "its camera; give the photo that the camera was made for, not cropped or rotated",
        )
    # The lens stays in its own pixels: the loader scales its look-up to the photo.
    as_stored, as_upright = (
        View(name, camera.scaled_to(*size), path, mask, lens, None, turned)
        for size, turned in ((stored, False), (upright, True))
    )
    if not fits(stored) and stored != upright:
        return as_upright
    return replace(as_stored, other=as_upright) if orientation != 1 and fits(upright) else as_stored


def scene_of(
    points: ModelPoints,
    views: dict[int, View],
    *,
    source: Source,
    left_out: tuple[tuple[str, str], ...] = (),
    notes: tuple[str, ...] = (),
) -> Scene:
    """The scene of `views`, by COLMAP's image id, with the points that at least one of them observes.

    Where most points have no track at all, the scene has these points instead, and no tracks: `points.with_points`
    judges them by the photos.
    """
    lengths = np.diff(points.offsets)
    finite = np.asarray(np.isfinite(points.positions).all(axis=1))
    loose = lengths == 0
    if 2 * loose.sum() > len(lengths):
        kept = loose & finite
        return Scene(
            tuple(views.values()),
            points.positions[kept],
            points.colors[kept],
            source,
            left_out=left_out,
            notes=notes,
        )
    if loose.any():
        notes = (*notes, f"{loose.sum()} points without tracks are not used: {(~loose).sum()} have.")
    of_point, of_view = _tracks(points, list(views))
    counted = finite[of_point]
    of_point, of_view = of_point[counted], of_view[counted]
    used, counts = np.unique(of_point, return_counts=True)
    return Scene(
        views=tuple(views.values()),
        points=points.positions[used],
        colors=points.colors[used],
        source=source,
        point_errors=points.errors[used],
        track_lengths=counts.astype(np.int32),
        point_views=PointViews(np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), of_view),
        left_out=left_out,
        notes=notes,
    )


def _tracks(points: ModelPoints, image_ids: list[int]) -> tuple[Integers, npt.NDArray[np.int32]]:
    """Index of the point and of the image of each observation by one of `image_ids`, once each, in order."""
    by_id = np.argsort(image_ids, kind="stable")
    ids = np.array(image_ids, np.int64)[by_id]
    known = np.flatnonzero(np.isin(points.images, ids))
    of_point = np.repeat(np.arange(len(points.errors)), np.diff(points.offsets))[known]
    of_view = by_id[np.searchsorted(ids, points.images[known])]
    views = max(1, len(ids))
    pairs = np.unique(of_point * views + of_view)
    return pairs // views, (pairs % views).astype(np.int32)
