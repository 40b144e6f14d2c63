"""Photos of a scene at the training size: upright, undistorted, reduced by the exact area filter."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from splatmill_worker.images import lens as lenses
from splatmill_worker.images.decode import Pixels, decode
from splatmill_worker.scene import Camera, Lens, View

MAX_SAMPLES = 4  # per axis and pixel when undistorting; the decoder leaves at most this reduction to do


@dataclass(frozen=True)
class Photo:
    """A photo ready to train on and the pinhole camera at its size.

    rgb [H,W,3] uint8 (over `background` where there was alpha and a background was asked for), alpha [H,W]
    uint8 where the file has it, mask [H,W] bool: True where the pixel may be trained on.
    """

    view: View
    camera: Camera
    rgb: Pixels
    alpha: Pixels | None
    mask: npt.NDArray[np.bool_] | None


def training_size(width: int, height: int, longest_side: int) -> tuple[int, int]:
    """Width and height with the longest side reduced to `longest_side`; a smaller photo is never enlarged."""
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
) -> list[Photo]:
    """Reads the views' photos with their longest side at `longest_side` pixels, several at a time.

    `background` (RGB in 0..1) is put behind photos with alpha; None leaves their colours as they are stored.
    Raises OSError for a file that is gone or does not decode.
    """
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return list(pool.map(lambda view: load_view(view, longest_side, background=background), views))


def load_view(
    view: View, longest_side: int, *, background: tuple[float, float, float] | None = None
) -> Photo:
    """One photo of `load_views`."""
    full = view.camera
    width, height = training_size(full.width, full.height, longest_side)
    # Undistortion looks up the photo at twice the training size, so that bilinear look-ups do not soften it.
    enough = (width, height) if view.lens is None else (2 * width, 2 * height)
    pixels = np.array(_decode_for(view, enough))
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    mask = None if view.mask is None else _read_mask(view, (pixels.shape[1], pixels.shape[0]))
    has_alpha = pixels.shape[2] == 4
    planes = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1).float()
    if mask is not None:
        planes = torch.cat([planes, torch.from_numpy(mask).float()[None] * 255.0])
    if has_alpha:
        # Averages of a half-covered pixel must not take colour from what alpha hides.
        planes[:3] *= planes[3:4] / 255.0
    keep = None
    if view.lens is None:
        planes = _area(planes, width, height)
    else:
        planes, seen = _undistort(planes, view.lens, full, width, height)
        keep = None if bool(seen.all()) else seen
    if mask is not None:
        keep = planes[-1] >= 127.5 if keep is None else keep & (planes[-1] >= 127.5)
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
        full.scaled_to(width, height),
        np.ascontiguousarray(_bytes(rgb).transpose(1, 2, 0)),
        alpha,
        None if keep is None else keep.numpy(),
    )


def _decode_for(view: View, enough: tuple[int, int]) -> Image.Image:
    """The photo's pixels with its longest side at least as asked, checked against the camera's shape."""
    photo = decode(view.image, at_least=enough, upright=view.upright)
    _check_shape(view, view.image, photo.size)
    return photo


def _check_shape(view: View, path: Path, size: tuple[int, int]) -> None:
    """Intrinsics scale with the photo, but a photo of another shape is another photo (or a turned one)."""
    width, height = size
    expected = view.camera.width / view.camera.height
    if abs(width / height / expected - 1.0) > 0.02 + 2.0 / min(width, height):
        raise ValueError(
            f"{path.name} is {width} x {height} but its camera is for {view.camera.width} x {view.camera.height}: "
            "a different shape. Give the photo the camera was made for."
        )


def _read_mask(view: View, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """The mask at the photo's decoded size: True where the pixel counts (COLMAP: black hides)."""
    assert view.mask is not None
    mask = decode(view.mask, upright=view.upright)
    _check_shape(view, view.mask, mask.size)
    # A mask drawn as transparency hides where it is transparent; any other, where it is dark.
    drawn = mask.mode == "RGBA" and np.asarray(mask)[:, :, 3].min() < 255
    grey = mask.getchannel("A") if drawn else mask.convert("L")
    return np.asarray(grey.resize(size, Image.Resampling.BOX)) >= 128


def _area(planes: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """[C,h,w] to [C,height,width] with each output pixel the exact mean over the area it covers."""
    if planes.shape[2] != width:
        planes = planes @ _area_weights(planes.shape[2], width).T
    if planes.shape[1] != height:
        planes = _area_weights(planes.shape[1], height) @ planes
    return planes


@lru_cache(maxsize=16)
def _area_weights(source: int, target: int) -> torch.Tensor:
    """[target, source]: the share of each source pixel in each target pixel, rows summing to 1."""
    edges = np.arange(target + 1) * (source / target)
    pixel = np.arange(source)
    overlap = np.minimum(edges[1:, None], pixel + 1.0) - np.maximum(edges[:-1, None], pixel)
    return torch.from_numpy(np.clip(overlap, 0.0, None) * (target / source)).float()


def _undistort(
    planes: torch.Tensor, lens: Lens, camera: Camera, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """[C,h,w] through the lens to [C,height,width] of the pinhole camera, and where it had a source [height,width]."""
    if planes.shape[2] > MAX_SAMPLES * width:
        planes = _area(planes, MAX_SAMPLES * width, MAX_SAMPLES * height)
    samples = max(1, min(MAX_SAMPLES, int(np.ceil(planes.shape[2] / width - 1e-6))))
    pinhole = camera.scaled_to(width, height)
    grid, seen = _look_up(lens, (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy), width, height, samples)
    taken = torch.nn.functional.grid_sample(
        planes[None],
        grid[None],
        # One sample per pixel means no averaging afterwards: the sharper look-up.
        mode="bilinear" if samples > 1 else "bicubic",
        padding_mode="border",
        align_corners=False,
    )
    return torch.nn.functional.avg_pool2d(taken, samples)[0].clamp(0.0, 255.0), seen


@lru_cache(maxsize=64)
def _look_up(
    lens: Lens, intrinsics: tuple[float, float, float, float], width: int, height: int, samples: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where samples x samples positions in each pixel of the pinhole camera lie in the photo.

    Returns the grid [samples * height, samples * width, 2] in grid_sample's -1..1 and the pixels whose centre
    the photo covers [height, width].
    """
    x, y = Camera(width, height, *intrinsics, np.eye(4)).normalized(
        (np.arange(width * samples) + 0.5) / samples, (np.arange(height * samples) + 0.5) / samples
    )
    rays = np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1).reshape(-1, 2)
    pixels = lenses.project(lenses.colmap_camera(lens), rays)
    grid = pixels / (lens.width, lens.height) * 2.0 - 1.0
    shape = height * samples, width * samples
    inside = np.all(np.abs(grid) <= 1.0 + 1.0 / min(lens.width, lens.height), axis=1).reshape(shape)
    seen = inside.reshape(height, samples, width, samples).all(axis=(1, 3))
    return torch.from_numpy(grid.reshape(*shape, 2)).float(), torch.from_numpy(seen)


def _bytes(values: torch.Tensor) -> Pixels:
    return np.asarray(values.round().clamp(0.0, 255.0).to(torch.uint8).numpy())
