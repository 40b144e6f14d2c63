"""A COLMAP reconstruction (text or binary files, or one just made) as a Scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.colmap import pycolmap
from splatmill_worker.images.decode import upright_size
from splatmill_worker.images.lens import lens_of, pinhole, without_distortion
from splatmill_worker.scene import Camera, Lens, PointViews, Scene, Source, View
from splatmill_worker.sfm.files import ImageFiles


def load(folder: Path, files: ImageFiles, notes: tuple[str, ...] = ()) -> Scene:
    """Reads the model in `folder` and finds its photos among `files`.

    Intrinsics made from photos of another size are scaled to the files. Raises ValueError where the model
    cannot be read or none of its photos is there.
    """
    try:
        model = pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError, OSError, IndexError) as error:
        raise ValueError(
            f"The COLMAP model in {folder.name}/ could not be read ({_first_line(error)}). "
            "It needs cameras, images and points3D, all as .bin or all as .txt."
        ) from error
    views: dict[int, View] = {}
    missing: list[tuple[str, str]] = []
    for image_id in sorted(model.reg_image_ids(), key=lambda image_id: model.images[image_id].name):
        image = model.images[image_id]
        found = files.photo(image.name)
        if found is None:
            missing.append((image.name, "the model has a camera for it, but the photo is not here"))
            continue
        name, path = found
        views[image_id] = posed_view(model, image_id, name, path, files.mask(name))
    if not views:
        raise ValueError(
            f"The COLMAP model names {len(missing)} photos (such as {missing[0][0]!r}) and none of them is here. "
            "Give the photos under the names the model uses."
            if missing
            else "The COLMAP model has no registered photo. Leave it out, or give one that has."
        )
    used = {view.image for view in views.values()}
    without = [
        (name, "the model has no camera for it") for name, path in files.photos.items() if path not in used
    ]
    return scene_of(model, views, source="colmap", left_out=(*missing, *without), notes=notes)


def posed_view(
    model: pycolmap.Reconstruction, image_id: int, name: str, path: Path, mask: Path | None
) -> View:
    """The view of a registered image, its camera scaled to the size of the file at `path`."""
    image = model.images[image_id]
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    return fit_to_file(camera_and_lens(model.cameras[image.camera_id], viewmat), name, path, mask)


def camera_and_lens(camera: pycolmap.Camera, viewmat: npt.NDArray[np.float64]) -> tuple[Camera, Lens | None]:
    """The pinhole camera, and the lens where the photo has one."""
    lens = lens_of(camera)
    if lens is not None:
        return pinhole(lens, viewmat), lens
    return replace(without_distortion(camera), viewmat=viewmat), None


def fit_to_file(posed: tuple[Camera, Lens | None], name: str, path: Path, mask: Path | None) -> View:
    """A view whose camera is at the size of the file; whether the EXIF orientation counts follows from the shape.

    Tools that ignore the orientation gave a camera for the pixels as stored; those that apply it, for the
    upright photo. Where both shapes fit, pixels are taken as stored, as most tools do.
    """
    camera, lens = posed
    with Image.open(path) as image:
        stored, upright = image.size, upright_size(image)
    aspect = camera.width / camera.height
    stored_fits = abs(stored[0] / stored[1] / aspect - 1.0) < 0.02
    turned = not stored_fits and stored != upright
    width, height = upright if turned else stored
    # The lens keeps its own pixels: the loader looks it up in shares of the photo's size.
    return View(name, camera.scaled_to(width, height), path, mask, lens, None, turned)


def scene_of(
    model: pycolmap.Reconstruction,
    views: dict[int, View],
    *,
    source: Source,
    left_out: tuple[tuple[str, str], ...] = (),
    notes: tuple[str, ...] = (),
    keep: Callable[[pycolmap.Point3D], bool] | None = None,
) -> Scene:
    """The views and the model's points that at least one of them sees."""
    order = {image_id: index for index, image_id in enumerate(views)}
    points, colors, errors, rows = [], [], [], []
    for point in model.points3D.values():
        row = sorted(
            {order[element.image_id] for element in point.track.elements if element.image_id in order}
        )
        if row and np.isfinite(point.xyz).all() and (keep is None or keep(point)):
            points.append(point.xyz)
            colors.append(point.color)
            errors.append(point.error)
            rows.append(row)
    lengths = np.array([len(row) for row in rows], np.int32)
    return Scene(
        views=tuple(views.values()),
        points=np.array(points, np.float64).reshape(-1, 3),
        colors=np.array(colors, np.uint8).reshape(-1, 3),
        source=source,
        point_errors=np.array(errors, np.float64),
        track_lengths=lengths,
        point_views=PointViews(
            np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
            np.array([index for row in rows for index in row], np.int32),
        ),
        left_out=left_out,
        notes=notes,
    )


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1][:200]
