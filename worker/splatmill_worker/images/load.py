"""Loads photos at the training size: upright, undistorted, and reduced by an exact area filter."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from splatmill_worker.images import look_ups
from splatmill_worker.images.decode import Pixels
from splatmill_worker.images.decoding.decoders import decode
from splatmill_worker.images.masks import shown_part
from splatmill_worker.images.panoramas import divided_photos, faces
from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.scene import MIN_SHOWN, Camera, Lens, View

MAX_SAMPLES = 4
"""Largest number of look-ups per pixel and axis when a photo is undistorted; a larger photo is reduced first."""

MIN_COVER = 127.5
"""Mean of the mask over a reduced pixel, 0 to 255, from which the pixel is trained on."""


@dataclass(frozen=True)
class Photo:
    """A photo ready to train on.

    view: the view that it was loaded for.
    camera: the pinhole camera at its size.
    rgb: uint8 [H,W,3]; over the background that `load_view` was given, when the file has alpha.
    alpha: uint8 [H,W]; None when the file has none.
    mask: bool [H,W], True for pixels to train on; None: all of them.
    """

    view: View
    camera: Camera
    rgb: Pixels
    alpha: Pixels | None
    mask: npt.NDArray[np.bool_] | None


def training_size(width: int, height: int, longest_side: int) -> tuple[int, int]:
    """Width and height in pixels, reduced so that the longest side has `longest_side`; never enlarged."""
    if longest_side < 1:
        raise ValueError(f"longest_side is {longest_side}; it must be at least 1 pixel.")
    factor = min(1.0, longest_side / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def load_views(
    views: Sequence[View],
    longest_side: int,
    *,
    background: tuple[float, float, float] | None = None,
    threads: int | None = None,
    files: PixelFiles | None = None,
    told: Callable[[int], None] = lambda loaded: None,
) -> list[Photo]:
    """Load the photos of `views`, several at a time.

    longest_side: in pixels; smaller photos keep their size.
    background: RGB, 0 to 1, behind transparent pixels; None keeps their stored colours.
    threads: photos loaded at a time; None: one per core.
    files: where pixels are kept; None: in memory.
    told: called after each photo with how many are loaded.

    Raises UnusablePicture for a file that does not decode, OSError for one that is missing, or for a full disk, and
    ValueError for one whose shape differs from its camera's.
    """
    sizes = [training_size(view.camera.width, view.camera.height, longest_side) for view in views]
    block = _Block(sizes) if files is None else _Filed(files)
    try:
        order = _order(views, sizes)
        with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
            loaded = pool.map(
                lambda index: block.moved(
                    index, load_view(views[index], longest_side, background=background)
                ),
                order,
            )
            photos: dict[int, Photo] = {}
            for index, photo in zip(order, loaded, strict=True):
                photos[index] = photo
                told(len(photos))
            return [photos[index] for index in range(len(views))]
    finally:
        look_ups.forget()
        divided_photos.forget()


def _order(views: Sequence[View], sizes: Sequence[tuple[int, int]]) -> list[int]:
    """The indices of the views in the order in which they are loaded: of as many photos as are kept decoded, first all
    faces in one direction, whose look-ups are then those of the face before."""
    places: dict[str, int] = {}
    keys = []
    kept = 0
    for index, (view, (width, height)) in enumerate(zip(views, sizes, strict=True)):
        if view.face is None:
            keys.append((kept // divided_photos.KEPT_BYTES, 0, index))
            continue
        if view.photo not in places:
            places[view.photo] = kept // divided_photos.KEPT_BYTES
            whole = faces.enough(view.face, view.camera.scaled_to(width, height))
            kept += 2 * 4 * whole[0] * whole[1]
        direction = list(faces.FACES).index(view.name.removeprefix(f"{view.photo}/"))
        keys.append((places[view.photo], direction, index))
    return sorted(range(len(views)), key=lambda index: keys[index])


class _Filed:
    """Moves the pixels of photos into files."""

    def __init__(self, files: PixelFiles) -> None:
        self._files = files

    def moved(self, index: int, photo: Photo) -> Photo:
        """The photo with its pixels in a file."""
        alpha, mask = (
            None if plane is None else self._files.placed(plane) for plane in (photo.alpha, photo.mask)
        )
        return replace(photo, rgb=self._files.placed(photo.rgb), alpha=alpha, mask=mask)


class _Block:
    """Memory for the pixels of all photos, allocated at once for each of rgb, alpha and mask.

    Loading frees arrays that are far larger than a photo. With a photo allocated between every two of them, the heap
    of the process stays in pieces that are never returned, at twice the size of all photos (decisions: PHOTO_BLOCK).
    """

    def __init__(self, sizes: Sequence[tuple[int, int]]) -> None:
        self._sizes = sizes
        self._starts = np.cumsum([0, *(width * height for width, height in sizes)])
        self._blocks: dict[str, npt.NDArray[np.uint8]] = {}
        self._lock = threading.Lock()

    def moved(self, index: int, photo: Photo) -> Photo:
        """The photo number `index` with its pixels in the block."""
        alpha = None if photo.alpha is None else self._place("alpha", index, photo.alpha)
        mask = None if photo.mask is None else self._place("mask", index, photo.mask).view(np.bool_)
        return replace(photo, rgb=self._place("rgb", index, photo.rgb), alpha=alpha, mask=mask)

    def _place(self, name: str, index: int, values: npt.NDArray[Any]) -> Pixels:
        width, height = self._sizes[index]
        channels = values.size // (width * height)
        with self._lock:
            if name not in self._blocks:
                self._blocks[name] = np.empty(channels * self._starts[-1], np.uint8)
        start, end = channels * self._starts[index : index + 2]
        place = self._blocks[name][start:end].reshape(values.shape)
        place[...] = values
        return place


def load_view(
    view: View, longest_side: int, *, background: tuple[float, float, float] | None = None
) -> Photo:
    """Load the photo of one view; arguments and errors are those of `load_views`."""
    full = view.camera
    width, height = training_size(full.width, full.height, longest_side)
    camera = full.scaled_to(width, height)
    visible = None
    if view.face is not None:
        size = faces.enough(view.face, camera)
        key = view.image, view.mask, view.shown_from, view.upright, size
        whole = divided_photos.of(key, lambda: faces.prepared(_layers(view, size), view.mask is None, size))
        planes, visible = faces.resampled(whole, view.face, camera)
        has_alpha = len(planes) - (view.mask is not None) == 4
    else:
        # Undistortion interpolates a photo of at least twice the size, so that it does not blur.
        layers = _layers(view, (width, height) if view.lens is None else (2 * width, 2 * height))
        planes = torch.from_numpy(np.ascontiguousarray(layers)).permute(2, 0, 1).float()
        has_alpha = len(planes) - (view.mask is not None) == 4
        if has_alpha:
            # Premultiplied, so that averages take no colour from transparent pixels.
            planes[:3] *= planes[3:4] / 255.0
    if view.lens is None:
        planes = _area(planes, width, height)
    else:
        planes, visible = _undistort(planes, view.lens, camera)
    keep = None if visible is None or bool(visible.all()) else visible
    if view.mask is not None:
        keep = planes[-1] >= MIN_COVER if keep is None else keep & (planes[-1] >= MIN_COVER)
    alpha = None
    rgb = planes[:3]
    if has_alpha:
        cover = planes[3:4] / 255.0
        alpha = _bytes(planes[3])
        if background is None:
            rgb = torch.where(cover > 0, rgb / cover.clamp(min=1e-6), rgb)
        else:
            rgb = rgb + (1.0 - cover) * 255.0 * torch.tensor(background, dtype=torch.float32)[:, None, None]
    return Photo(
        view,
        camera,
        np.ascontiguousarray(_bytes(rgb).transpose(1, 2, 0)),
        alpha,
        None if keep is None else keep.numpy(),
    )


def _layers(view: View, enough: tuple[int, int]) -> Pixels:
    """The photo at least as large as `enough`, [H,W,C], and its mask as the last channel, 255 where it shows."""
    pixels = np.array(_decode_for(view, enough))
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    if view.mask is not None:
        mask = _read_mask(view, (pixels.shape[1], pixels.shape[0]))
        pixels = np.concatenate([pixels, np.uint8(255) * mask[:, :, None]], axis=2)
    return pixels


def _decode_for(view: View, enough: tuple[int, int]) -> Image.Image:
    """The photo at least as large as `enough` (width, height), its shape checked against the camera's."""
    photo = decode(view.image, at_least=enough, upright=view.upright)
    _check_shape(view, view.image, photo.size)
    return photo


def _check_shape(view: View, path: Path, size: tuple[int, int]) -> None:
    """Raise ValueError for a photo or mask whose aspect ratio differs from the camera's by more than rounding."""
    width, height = size
    whole = view.camera if view.face is None else view.face
    expected = whole.width / whole.height
    # Reduced sizes are rounded to whole pixels, which changes the aspect ratio of small photos the most.
    if abs(width / height / expected - 1.0) > 0.02 + 2.0 / min(width, height):
        raise ValueError(
            f"{path.name} has {width} x {height} pixels, a different shape from the {whole.width} x "
            f"{whole.height} of its camera. Give the file that the camera was made for, not cropped or rotated."
        )


def _read_mask(view: View, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """The mask at `size` (width, height): True for pixels to train on."""
    assert view.mask is not None
    mask = decode(view.mask, upright=view.upright)
    _check_shape(view, view.mask, mask.size)
    return np.asarray(shown_part(mask, view.shown_from).resize(size, Image.Resampling.BOX)) >= MIN_SHOWN


def _area(planes: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Planes [C,h,w] resampled to [C,height,width]; each pixel is the exact mean over the area that it covers."""
    if planes.shape[2] != width:
        planes = planes @ _area_weights(planes.shape[2], width).T
    if planes.shape[1] != height:
        planes = _area_weights(planes.shape[1], height) @ planes
    return planes


@lru_cache(maxsize=16)
def _area_weights(source: int, target: int) -> torch.Tensor:
    """Weights [target, source] of each source pixel in each target pixel; rows sum to 1."""
    edges = np.arange(target + 1) * (source / target)
    pixel = np.arange(source)
    overlap = np.minimum(edges[1:, None], pixel + 1.0) - np.maximum(edges[:-1, None], pixel)
    return torch.from_numpy(np.clip(overlap, 0.0, None) * (target / source)).float()


def _undistort(planes: torch.Tensor, lens: Lens, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Planes [C,h,w] of the photo as [C,height,width] of `camera`, and which pixels the photo covers [height,width]."""
    width, height = camera.width, camera.height
    if planes.shape[2] > MAX_SAMPLES * width:
        planes = _area(planes, MAX_SAMPLES * width, MAX_SAMPLES * height)
    samples = max(1, min(MAX_SAMPLES, int(np.ceil(planes.shape[2] / width - 1e-6))))
    return look_ups.resampled(planes, lens, camera, samples)


def _bytes(values: torch.Tensor) -> Pixels:
    """Values from 0 to 255, rounded to uint8."""
    return np.asarray(values.round().clamp(0.0, 255.0).to(torch.uint8).numpy())
