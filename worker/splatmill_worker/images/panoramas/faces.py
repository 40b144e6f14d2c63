"""Divides panoramas into faces: pinhole photos that together show all directions, and are trained as other photos are.

The faces are those of a cube, from the panorama's own middle on. No file of them is written: each is resampled from the
panorama and its mask when it is loaded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from splatmill_worker.images.decode import Pixels
from splatmill_worker.images.lens import PANORAMA
from splatmill_worker.scene import Camera, Face, Float, Lens, PointViews, Scene, View, viewmat_of

FACES: dict[str, Float] = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "back": np.diag([-1.0, 1.0, -1.0]),
    "left": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotation of each face, from the panorama's frame to that of the face's camera."""

HALF_ANGLE = 45.0
"""Degrees from the axis of a face to its sides (decisions: panorama-faces)."""

BAND = 2**18
"""Positions that are looked up at a time: each takes about 200 bytes meanwhile."""

MAX_SAMPLES = 2
"""Largest number of look-ups per pixel and axis; a larger panorama is reduced first."""


def is_panorama(view: View) -> bool:
    """Whether a view is a panorama that is not divided yet."""
    return view.lens is not None and view.lens.model == PANORAMA


def faces_of(view: View) -> tuple[View, ...]:
    """The faces of a panorama; any other view itself.

    A face has a quarter of the panorama's width, so that its pixels are on average as large as those of the panorama.
    """
    if not is_panorama(view):
        return (view,)
    width, center = view.camera.width, view.camera.center
    half = max(1, round(width / 8.0 * math.tan(math.radians(HALF_ANGLE))))
    focal = half / math.tan(math.radians(HALF_ANGLE))
    return tuple(
        replace(
            view,
            name=f"{view.name}/{name}",
            camera=Camera(
                2 * half,
                2 * half,
                focal,
                focal,
                half,
                half,
                viewmat_of(rotation @ view.camera.viewmat[:3, :3], center),
            ),
            lens=None,
            other=None,
            face=Face(view.name, width, rotation),
        )
        for name, rotation in FACES.items()
    )


def panorama_of(face: View) -> View:
    """The panorama that a view is a face of, as it was before `faces_of`; any other view itself."""
    if face.face is None:
        return face
    width, height = face.face.width, face.face.width // 2
    focal = width / (2.0 * math.pi)
    viewmat = viewmat_of(face.face.rotation.T @ face.camera.viewmat[:3, :3], face.camera.center)
    return replace(
        face,
        name=face.face.panorama,
        camera=Camera(width, height, focal, focal, width / 2.0, height / 2.0, viewmat),
        lens=Lens(PANORAMA, (float(width), float(height)), width, height),
        face=None,
    )


def cut(scene: Scene) -> Scene:
    """The scene with the faces of its panoramas in their place.

    A point that a panorama observes is observed by the face whose axis is nearest to it.
    """
    if not any(is_panorama(view) for view in scene.views):
        return scene
    parts = [faces_of(view) for view in scene.views]
    starts = np.cumsum([0, *map(len, parts)])
    panoramas, faces = sum(len(part) > 1 for part in parts), sum(len(part) for part in parts if len(part) > 1)
    size = next(part[0].camera.width for part in parts if len(part) > 1)
    note = (
        f"{panoramas} panoramas are trained as {faces} faces, pinhole photos of 90 degrees with up to "
        f"{size} x {size} pixels."
    )
    scene = replace(scene, views=tuple(view for part in parts for view in part), notes=(*scene.notes, note))
    if scene.point_views is None:
        return scene
    offsets, seen = scene.point_views
    points = scene.points[np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))]
    chosen = starts[seen]
    for index, part in enumerate(parts):
        if len(part) > 1:
            rows = np.flatnonzero(seen == index)
            axes = np.array([view.camera.axis for view in part])
            chosen[rows] += ((points[rows] - part[0].camera.center) @ axes.T).argmax(axis=1)
    return replace(scene, point_views=PointViews(offsets, chosen.astype(np.int32)))


def joined(scene: Scene) -> Scene:
    """The scene with each panorama as one view again, as it was before `cut`."""
    if all(view.face is None for view in scene.views):
        return scene
    views: dict[str, View] = {}
    for view in scene.views:
        views.setdefault(view.photo, panorama_of(view))
    scene_views = tuple(views.values())
    if scene.point_views is None:
        return replace(scene, views=scene_views)
    number = {name: index for index, name in enumerate(views)}
    of_view = np.array([number[view.photo] for view in scene.views], np.int64)
    offsets, seen = scene.point_views
    of_point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    # Stereo may have found a point in two faces of a panorama.
    pairs = np.unique(of_point * len(views) + of_view[seen])
    counts = np.bincount(pairs // len(views), minlength=len(offsets) - 1)
    point_views = PointViews(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), (pairs % len(views)).astype(np.int32)
    )
    return replace(scene, views=scene_views, point_views=point_views)


def photos_of(views: Iterable[View]) -> int:
    """Number of photos that views show."""
    return len({view.photo for view in views})


def enough(camera: Camera) -> tuple[int, int]:
    """Width and height of the panorama of which a face's camera resamples MAX_SAMPLES pixels for each of its own."""
    half = math.ceil(MAX_SAMPLES * math.pi * camera.fx)
    return 2 * half, half


def prepared(layers: Pixels, unmasked: bool, size: tuple[int, int]) -> Pixels:
    """A decoded panorama [H,W,C] for `resampled`: at most as large as `size`, and its colours multiplied by its alpha,
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


def resampled(pixels: Pixels, face: Face, camera: Camera) -> torch.Tensor:
    """The pixels [H,W,C] of a panorama as planes float32 [C,height,width] of a face's `camera`."""
    height, width, channels = pixels.shape
    samples = max(1, min(MAX_SAMPLES, math.ceil(width / (2.0 * math.pi * camera.fx) - 1e-6)))
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
