"""Divides panoramas, and photos of lenses that see nearly all that is ahead, into faces: pinhole photos that together
show all directions, and are trained as other photos are.

The faces are those of a cube, from the photo's own middle on. Of a lens that does not see all directions, those are
used that it sees enough of, cropped to what it sees. No file of them is written: each is resampled from the photo and
its mask when it is loaded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from PIL import Image

from splatmill_worker.images import look_ups
from splatmill_worker.images.decode import Pixels
from splatmill_worker.images.lens import (
    PANORAMA,
    colmap_camera,
    distort,
    is_cut,
    pinhole,
    without_distortion,
)
from splatmill_worker.scene import Camera, Face, Float, Lens, PointViews, Scene, View, viewmat_of

FACES: dict[str, Float] = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "back": np.diag([-1.0, 1.0, -1.0]),
    "left": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotation of each face, from the frame of the photo's camera to that of the face's camera."""

HALF_ANGLE = 45.0
"""Degrees from the axis of a face to its sides (decisions: panorama-faces)."""

MIN_SHARE = 0.25
"""Share of a face that a lens must see for the face to be used (decisions: wide-lens-faces)."""

LOOKED_UP = 64
"""Positions along each side of a face at which it is found out what a lens sees of it."""

BAND = 2**18
"""Positions that are looked up at a time: each takes about 200 bytes meanwhile."""

MAX_SAMPLES = 2
"""Largest number of look-ups per pixel and axis; a larger panorama is reduced first."""


def is_panorama(view: View) -> bool:
    """Whether a view is a panorama that is not divided yet."""
    return view.lens is not None and view.lens.model == PANORAMA


def is_divided(view: View) -> bool:
    """Whether a view is trained as several faces, and is not divided yet."""
    return view.lens is not None and (view.lens.model == PANORAMA or len(_seen_parts(view.lens)) > 1)


def faces_of(view: View) -> tuple[View, ...]:
    """The faces of a panorama or of a photo of a wide lens; any other view itself.

    A face has as many pixels for an angle as the photo: of a panorama, a quarter of its width, and of a lens, as in its
    middle.
    """
    if view.lens is None or not is_divided(view):
        return (view,)
    lens, center = view.lens, view.camera.center
    per_radian = _pixels_per_radian(lens) * view.camera.width / lens.width
    half = max(1, round(per_radian * math.pi / 4.0 * math.tan(math.radians(HALF_ANGLE))))
    focal = half / math.tan(math.radians(HALF_ANGLE))
    divided = []
    for name, (left, top, right, bottom) in _seen_parts(lens).items():
        viewmat = viewmat_of(FACES[name] @ view.camera.viewmat[:3, :3], center)
        side = Camera(2 * half, 2 * half, focal, focal, half, half, viewmat)
        column, row = (math.floor(2 * half * start) for start in (left, top))
        width, height = (math.ceil(2 * half * end) - start for end, start in ((right, column), (bottom, row)))
        divided.append(
            replace(
                view,
                name=f"{view.name}/{name}",
                camera=side.cropped(column, row, width, height),
                lens=None,
                other=None,
                face=Face(view.name, lens, view.camera.width, view.camera.height, FACES[name]),
            )
        )
    return tuple(divided)


def _pixels_per_radian(lens: Lens) -> float:
    """Pixels of the photo for a radian: of a panorama along its middle, and of a lens in its middle."""
    return lens.width / (2.0 * math.pi) if lens.model == PANORAMA else colmap_camera(lens).mean_focal_length()


@lru_cache(maxsize=4096)
def _seen_parts(lens: Lens) -> dict[str, tuple[float, float, float, float]]:
    """Of each face that a lens sees enough of, the first and the last column and row that it sees, as shares of the
    side: left, top, right, bottom. Nothing where one pinhole camera shows what the lens sees."""
    if lens.model == PANORAMA:
        return dict.fromkeys(FACES, (0.0, 0.0, 1.0, 1.0))
    if not is_cut(lens):
        return {}
    middles = (2.0 * (np.arange(LOOKED_UP) + 0.5) / LOOKED_UP - 1.0) * math.tan(math.radians(HALF_ANGLE))
    rays = np.stack([*np.meshgrid(middles, middles, indexing="xy"), np.ones((LOOKED_UP, LOOKED_UP))], axis=-1)
    parts = {}
    for name, rotation in FACES.items():
        at = distort(lens, rays.reshape(-1, 3) @ rotation).reshape(LOOKED_UP, LOOKED_UP, 2)
        visible = np.all((at >= 0.0) & (at <= (lens.width, lens.height)), axis=2)
        if visible.mean() >= MIN_SHARE:
            rows, columns = np.nonzero(visible)
            parts[name] = (
                float(columns.min()) / LOOKED_UP,
                float(rows.min()) / LOOKED_UP,
                float(columns.max() + 1) / LOOKED_UP,
                float(rows.max() + 1) / LOOKED_UP,
            )
    return parts


def whole_of(face: View) -> View:
    """The view that a view is a face of, as it was before `faces_of`; any other view itself."""
    if face.face is None:
        return face
    lens = face.face.lens
    viewmat = viewmat_of(face.face.rotation.T @ face.camera.viewmat[:3, :3], face.camera.center)
    camera = (
        replace(without_distortion(colmap_camera(lens)), viewmat=viewmat)
        if lens.model == PANORAMA
        else pinhole(lens, viewmat)
    )
    camera = camera.scaled_to(face.face.width, face.face.height)
    return replace(face, name=face.face.photo, camera=camera, lens=lens, face=None)


def cut(scene: Scene) -> Scene:
    """The scene with the faces of its panoramas and of its photos of wide lenses in their place.

    A point that such a photo observes is observed by the face whose axis is nearest to it.
    """
    if not any(is_divided(view) for view in scene.views):
        return scene
    parts = [faces_of(view) for view in scene.views]
    starts = np.cumsum([0, *map(len, parts)])
    scene = replace(
        scene,
        views=tuple(view for part in parts for view in part),
        notes=(*scene.notes, *_notes(part for part in parts if len(part) > 1)),
    )
    if scene.point_views is None:
        return scene
    offsets, observers = scene.point_views
    points = scene.points[np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))]
    chosen = starts[observers]
    for index, part in enumerate(parts):
        if len(part) > 1:
            rows = np.flatnonzero(observers == index)
            axes = np.array([view.camera.axis for view in part])
            chosen[rows] += ((points[rows] - part[0].camera.center) @ axes.T).argmax(axis=1)
    return replace(scene, point_views=PointViews(offsets, chosen.astype(np.int32)))


def _notes(divided: Iterable[tuple[View, ...]]) -> list[str]:
    """A sentence about the faces of panoramas, and one about those of each kind of lens."""
    photos, faces, sides = Counter[str](), Counter[str](), Counter[str]()
    for part in divided:
        assert part[0].face is not None
        kind = part[0].face.lens.model
        photos[kind] += 1
        faces[kind] += len(part)
        sides[kind] = max(max(view.camera.width, view.camera.height) for view in part)
    said = []
    for kind, count in photos.items():
        what = f"{count} panoramas" if kind == PANORAMA else f"{count} photos of a wide lens ({kind})"
        said.append(
            f"{what} are trained as {faces[kind]} faces, pinhole photos of up to 90 degrees with up to "
            f"{sides[kind]} pixels on a side."
        )
    return said


def joined(scene: Scene) -> Scene:
    """The scene with each divided photo as one view again, as it was before `cut`."""
    if all(view.face is None for view in scene.views):
        return scene
    views: dict[str, View] = {}
    for view in scene.views:
        views.setdefault(view.photo, whole_of(view))
    scene_views = tuple(views.values())
    if scene.point_views is None:
        return replace(scene, views=scene_views)
    number = {name: index for index, name in enumerate(views)}
    of_view = np.array([number[view.photo] for view in scene.views], np.int64)
    offsets, observers = scene.point_views
    of_point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    # Stereo may have found a point in two faces of a photo.
    pairs = np.unique(of_point * len(views) + of_view[observers])
    counts = np.bincount(pairs // len(views), minlength=len(offsets) - 1)
    point_views = PointViews(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), (pairs % len(views)).astype(np.int32)
    )
    return replace(scene, views=scene_views, point_views=point_views)


def photos_of(views: Iterable[View]) -> int:
    """Number of photos that views show."""
    return len({view.photo for view in views})


def enough(face: Face, camera: Camera) -> tuple[int, int]:
    """Width and height of the photo of which a face's camera resamples MAX_SAMPLES pixels for each of its own."""
    lens = face.lens
    height = math.ceil(MAX_SAMPLES * camera.fx / _pixels_per_radian(lens) * lens.height)
    return round(height * lens.width / lens.height), height


def prepared(layers: Pixels, unmasked: bool, size: tuple[int, int]) -> Pixels:
    """A decoded photo [H,W,C] for `resampled`: at most as large as `size`, and its colours multiplied by its alpha,
    the fourth channel.

    unmasked: whether the last channel is no mask.
    """
    if layers.shape[2] == (4 if unmasked else 5):
        colors, alpha = layers[:, :, :3].astype(np.uint16), layers[:, :, 3:4]
        layers = np.concatenate([((colors * alpha + 127) // 255).astype(np.uint8), layers[:, :, 3:]], axis=2)
    if layers.shape[1] > size[0]:
        channels = (Image.fromarray(layers[:, :, channel]) for channel in range(layers.shape[2]))
        layers = np.stack([np.asarray(each.resize(size, Image.Resampling.BOX)) for each in channels], axis=2)
    return np.ascontiguousarray(layers)


def resampled(pixels: Pixels, face: Face, camera: Camera) -> tuple[torch.Tensor, torch.Tensor | None]:
    """The pixels [H,W,C] of a photo as planes float32 [C,height,width] of a face's `camera`, and which pixels the photo
    covers [height,width]; None: all of them."""
    per_radian = _pixels_per_radian(face.lens) * pixels.shape[1] / face.lens.width
    samples = max(1, min(MAX_SAMPLES, math.ceil(per_radian / camera.fx - 1e-6)))
    if face.lens.model == PANORAMA:
        return _resampled_panorama(pixels, face, camera, samples), None
    planes, visible = look_ups.resampled(
        torch.from_numpy(pixels).permute(2, 0, 1).float(), face.lens, camera, samples, face.rotation
    )
    return planes, visible


def _resampled_panorama(pixels: Pixels, face: Face, camera: Camera, samples: int) -> torch.Tensor:
    height, width, channels = pixels.shape
    source = torch.from_numpy(pixels.reshape(-1, channels))
    planes = torch.empty((channels, camera.height, camera.width))
    rows = max(1, BAND // (samples * samples * camera.width))
    for top in range(0, camera.height, rows):
        part = slice(top, min(top + rows, camera.height))
        x, y = _places(face, camera, part, samples, width, height)
        looked_up = _bilinear(source, x, y, width, height)
        shape = (part.stop - top, samples, camera.width, samples, channels)
        planes[:, part] = looked_up.reshape(shape).mean(dim=(1, 3)).permute(2, 0, 1)
    return planes


def _places(
    face: Face, camera: Camera, rows: slice, samples: int, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where samples of some rows of a face lie on a panorama, in pixels; the centre of its first pixel is at 0."""
    column = (torch.arange(samples * camera.width) + 0.5) / samples
    row = (torch.arange(samples * rows.start, samples * rows.stop) + 0.5) / samples
    x, y = camera.normalized(column, row)
    rays = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(len(y), len(x))], dim=-1).reshape(
        -1, 3
    )
    right, down, ahead = (rays @ torch.from_numpy(face.rotation).float()).T
    longitude, latitude = torch.atan2(right, ahead), torch.atan2(down, torch.hypot(right, ahead))
    return (
        (longitude / (2.0 * math.pi) + 0.5) * width - 0.5,
        (latitude / math.pi + 0.5) * height - 0.5,
    )


def _bilinear(
    source: torch.Tensor, x: torch.Tensor, y: torch.Tensor, width: int, height: int
) -> torch.Tensor:
    """Values [n,C] between the pixels of a panorama [H*W,C], whose left and right borders meet."""
    left, top = x.floor(), y.floor()
    across, along = (x - left)[:, None], (y - top)[:, None]
    columns = [(left.long() + step) % width for step in (0, 1)]
    lines = [(top.long() + step).clamp(0, height - 1) * width for step in (0, 1)]
    upper, lower = (
        torch.lerp(source[line + columns[0]].float(), source[line + columns[1]].float(), across)
        for line in lines
    )
    return torch.lerp(upper, lower, along)
