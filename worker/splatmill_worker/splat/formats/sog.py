"""The SOG format, version 2: lossless WebP images and a `meta.json`, in a zip archive or beside each other.

Source: PlayCanvas, "The SOG Format" (developer.playcanvas.com, user manual, Gaussian splatting). The values are those
of the standard `.ply`, in its frame: the specification's "y up, z back" is what a viewer makes of them.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from splatmill.files import replacing
from splatmill_worker.errors import ModelUnreadable, UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.archives.archive import DAMAGED
from splatmill_worker.kernels.morton import morton_order
from splatmill_worker.readers.reader_memory import check_gaussians
from splatmill_worker.splat.formats import palette, sog_files
from splatmill_worker.splat.formats.contents import (
    NO_OFFSET,
    Contents,
    Offset,
    logits,
    unit,
    visible,
)
from splatmill_worker.splat.gaussians import REST_COEFFICIENTS, Gaussians
from splatmill_worker.wording import plain

VERSION = 2
CENTROIDS_PER_ROW = 64
"""Centroids in a row of `shN_centroids.webp`, by the specification."""

MAX_CENTROIDS = 65536
"""A label has 16 bits."""

GAUSSIANS_PER_CENTROID = 10
LEAST_CENTROIDS, MOST_CENTROIDS = 1024, 8192
"""Bounds on the number of centroids; between them, a centroid stands for GAUSSIANS_PER_CENTROID (decisions: sog)."""

MAX_META_BYTES = 2**20
"""Bytes of a `meta.json`, which has some ten kilobytes; Python takes up to thirty times as many to parse it."""

PIXELS_PER_GAUSSIAN, MORE_PIXELS = 4, 2**16
"""An image of N Gaussians has this many pixels for each, and more pixels besides, at most. Writers make images of about
the root of N on a side."""

_IMAGES = {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}
"""Images of each part."""

FORMATS = ("WEBP", "PNG")
"""Pillow's names of the formats that are read. The specification has WebP as its default, and allows any with RGBA
values of 8 bits."""

_MODELS = {"default": False, "antialiased": True, "2dgs": False}
"""Whether Gaussians are drawn antialiased, by the field `model` of the `meta.json`."""

Plane = npt.NDArray[np.uint8]

_ROWS = 2**16
"""Quaternions that are unpacked at a time: in float64, all of them would be most of the memory of a reader."""

_ROOT_HALF = math.sqrt(0.5)
_OTHERS = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The three components besides the largest, in the order of their bytes."""


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    centroids: int | None = None,
) -> int:
    """Write `gaussians` as a `.sog` archive; returns how many were written.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY of the `.ply` are left out.
    offset, antialiased: of `Contents`. centroids: size of the palette of harmonics, by default chosen from the number
    of Gaussians. The file is replaced atomically and synced.
    """
    gaussians = visible(gaussians)
    gaussians = gaussians.select(morton_order(_logged(gaussians.means.double())))
    with (
        replacing(path, sync=True) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive,
    ):
        for name, content in encoded(gaussians, offset=offset, antialiased=antialiased, centroids=centroids):
            archive.writestr(member(name), content)
    return gaussians.count


def encoded(
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    centroids: int | None = None,
) -> Iterator[tuple[str, bytes]]:
    """The files of a model by name, `meta.json` first; the Gaussians keep their order.

    gaussians: such as `visible` returns. offset, antialiased, centroids: as in `write`.
    """
    count = gaussians.count
    shown = importance(gaussians)
    logged = _logged(gaussians.means.double())
    low = logged.amin(0) if count else logged.new_zeros(3)
    high = logged.amax(0) if count else logged.new_zeros(3)
    codes = ((logged - low) / (high - low).clamp(min=1e-300) * 65535).round().clamp(0, 65535).long()
    scales = palette.scalar_codebook(gaussians.log_scales, shown[:, None].expand(-1, 3))
    colors = palette.scalar_codebook(gaussians.sh[:, 0], shown[:, None].expand(-1, 3))
    opacity = (torch.sigmoid(gaussians.logit_opacities) * 255).round().clamp(1, 255)
    images = {
        "means_l.webp": _plane(codes & 255),
        "means_u.webp": _plane(codes >> 8),
        "scales.webp": _plane(palette.nearest_scalar(gaussians.log_scales, scales)),
        "quats.webp": _plane(_packed(gaussians.quats)),
        "sh0.webp": _plane(
            torch.cat([palette.nearest_scalar(gaussians.sh[:, 0], colors), opacity.long()[:, None]], 1)
        ),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "Splatmill"},
        "count": count,
        "antialias": antialiased,
        "model": "antialiased" if antialiased else "default",
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    if any(offset):
        meta["splatmill"] = {"offset": list(offset)}
    if gaussians.degree and count:
        size = centroids or palette_size(count)
        labels, entries, book = _harmonics(gaussians.sh[:, 1:].flatten(1), shown, size)
        images["shN_labels.webp"] = _plane(torch.stack([labels & 255, labels >> 8, labels * 0], 1))
        images["shN_centroids.webp"] = _centroid_plane(entries)
        meta["shN"] = {
            "count": entries.shape[0],
            "bands": gaussians.degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    yield "meta.json", json.dumps(meta).encode()
    for name, plane in images.items():
        yield name, _webp(plane)


def read(path: Path) -> Contents:
    """Read a `.sog` archive, or the `meta.json` of one that lies unpacked beside its images.

    Raises ModelUnreadable for any other file and for earlier versions, and FileNotFoundError where there is none.
    """
    try:
        with sog_files.opened(path) as files:
            return contents(files)
    except FileNotFoundError:
        raise
    except UnusablePicture as error:
        raise ModelUnreadable(f"{path.name} cannot be read: {error.message}") from error
    except (*DAMAGED, OSError, ValueError, OverflowError, KeyError, TypeError, RecursionError) as error:
        raise ModelUnreadable(f"{path.name} could not be read as a SOG model: {plain(error)}.") from error


def importance(gaussians: Gaussians) -> Tensor:
    """What a Gaussian's error of colour weighs [N]: the root of its opacity times its area as seen from the middle.

    The area is the mean over all directions, divided by the squared distance to the median of the centres, so that a
    far shell counts as it is seen. Of the powers and factors tried, this one lost least (decisions: sog).
    """
    if not gaussians.count:
        return gaussians.means.new_zeros(0)
    a, b, c = gaussians.log_scales.double().exp().unbind(1)
    squared = (gaussians.means - gaussians.means.median(0).values).double().square().sum(1)
    area = (a * b + b * c + c * a) / (squared + squared.median()).clamp(min=1e-300)
    return (torch.sigmoid(gaussians.logit_opacities.double()) * area).sqrt()


def palette_size(count: int) -> int:
    """Centroids of the harmonics of `count` Gaussians: a multiple of CENTROIDS_PER_ROW within the bounds."""
    centroids = min(max(count // GAUSSIANS_PER_CENTROID, LEAST_CENTROIDS), MOST_CENTROIDS)
    return -(-centroids // CENTROIDS_PER_ROW) * CENTROIDS_PER_ROW


def _harmonics(rows: Tensor, weights: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Labels [N], entries [K, coefficients, 3] of the palette as indices into its codebook, and the codebook [256]."""
    centroids, labels = palette.palette(rows.contiguous(), weights, min(size, MAX_CENTROIDS))
    held = torch.zeros(centroids.shape[0], dtype=torch.float64).index_add_(0, labels, weights.double())
    book = palette.scalar_codebook(centroids, held[:, None].expand_as(centroids))
    entries = palette.nearest_scalar(centroids, book)
    return labels, entries.reshape(centroids.shape[0], -1, 3), book


def _packed(quats: Tensor) -> Tensor:
    """The three smaller components and the place of the largest [N, 4], as the specification packs quaternions."""
    turned = unit(quats)
    largest = turned.abs().argmax(1, keepdim=True)
    turned = turned * torch.where(turned.gather(1, largest) < 0, -1.0, 1.0)
    small = (turned.gather(1, _OTHERS[largest[:, 0]]) / _ROOT_HALF * 0.5 + 0.5) * 255
    return torch.cat([small.round().clamp(0, 255).long(), 252 + largest], 1)


def _unpacked(plane: Plane) -> Tensor:
    """Unit quaternions wxyz [N, 4]. Raises ValueError for an alpha that names no component."""
    if plane.shape[0] and int(plane[:, 3].min()) < 252:
        raise ValueError("quats.webp has alpha values under 252")
    quats = torch.zeros(plane.shape[0], 4)
    for begin in range(0, plane.shape[0], _ROWS):
        rows = plane[begin : begin + _ROWS]
        largest = torch.from_numpy(rows[:, 3].astype(np.int64)) - 252
        small = (torch.from_numpy(rows[:, :3].astype(np.float64)) / 255 * 2 - 1) * _ROOT_HALF
        full = (1 - small.square().sum(1, keepdim=True)).clamp(min=0).sqrt()
        part = torch.zeros(len(rows), 4, dtype=torch.float64)
        part = part.scatter(1, largest[:, None], full).scatter(1, _OTHERS[largest], small)
        quats[begin : begin + _ROWS] = part.float()
    return quats


def _plane(values: Tensor) -> Plane:
    """An image [H, W, 3 or 4] whose pixels are the rows of `values`, row by row; those behind the last are zero."""
    count, channels = values.shape
    width = -(-math.ceil(math.sqrt(max(count, 1))) // 4) * 4
    height = max(1, -(-count // width))
    plane = np.zeros((height * width, channels), dtype=np.uint8)
    plane[:count] = values.numpy().astype(np.uint8)
    return plane.reshape(height, width, channels)


def _centroid_plane(entries: Tensor) -> Plane:
    """The palette as an image: CENTROIDS_PER_ROW centroids in a row, each as many pixels as it has coefficients."""
    count, coefficients, _ = entries.shape
    height = -(-count // CENTROIDS_PER_ROW)
    plane = np.zeros((height * CENTROIDS_PER_ROW, coefficients, 3), dtype=np.uint8)
    plane[:count] = entries.numpy().astype(np.uint8)
    return plane.reshape(height, CENTROIDS_PER_ROW * coefficients, 3)


def _logged(means: Tensor) -> Tensor:
    """Positions as they are stored: the logarithm of one more than their size, with their sign."""
    return means.sign() * means.abs().log1p()


def _webp(plane: Plane) -> bytes:
    stream = io.BytesIO()
    # exact: by default the colour under an alpha of 0 is not kept. The quality is an effort here: the highest took
    # thirty times as long for as many bytes (decisions: sog).
    Image.fromarray(plane).save(stream, "WEBP", lossless=True, quality=40, method=2, exact=True)
    return stream.getvalue()


def member(name: str) -> zipfile.ZipInfo:
    """The same bytes for the same model: without the time."""
    return zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))


def contents(files: sog_files.Files) -> Contents:
    """The model in the files of a SOG. Raises what `read` turns into ModelUnreadable."""
    gaussians, meta = rows(files)
    return Contents.of(gaussians, *stated(meta))


def stated(meta: dict[str, Any]) -> tuple[Offset, bool | None]:
    """The offset and `Contents.antialiased` that a `meta.json` states. Raises as `contents`."""
    offset = NO_OFFSET
    if isinstance(meta.get("splatmill"), dict):
        x, y, z = _numbers(meta["splatmill"]["offset"], 3).tolist()
        offset = (x, y, z)
    return offset, _antialiased(meta)


def rows(files: sog_files.Files) -> tuple[Gaussians, dict[str, Any]]:
    """All rows of a SOG, also those that are not finite, and its `meta.json`. Raises as `contents`."""
    head = header(files)
    meta, count, degree, names = head.meta, head.count, head.degree, head.names
    largest = max(PIXELS_PER_GAUSSIAN * count + MORE_PIXELS, MAX_CENTROIDS * REST_COEFFICIENTS[degree])
    most = 4 * largest + MAX_META_BYTES  # an image that could not be compressed, with its metadata
    side: tuple[int, int] | None = None

    def plane(part: str, index: int, channels: int) -> Plane:
        nonlocal side
        name = names[part][index]
        pixels = _decoded(files, name, most, channels, partial(_check_side, name, count, side))
        side = pixels.shape[1], pixels.shape[0]
        return pixels.reshape(-1, channels)[:count]

    colors = plane("sh0", 0, 4)
    gaussians = Gaussians(
        means=_means(meta["means"], plane("means", 0, 3), plane("means", 1, 3)),
        log_scales=_looked_up(meta["scales"], plane("scales", 0, 3)),
        quats=_unpacked(plane("quats", 0, 4)),
        sh=_looked_up(meta["sh0"], colors[:, :3])[:, None],
        logit_opacities=logits(torch.from_numpy(colors[:, 3].astype(np.float32)) / 255),
    )
    if degree:
        centroids = _decoded(
            files, names["shN"][0], most, 3, partial(_check_palette, names["shN"][0], degree)
        )
        rest = _read_harmonics(meta["shN"], centroids, plane("shN", 1, 3))
        gaussians = replace(gaussians, sh=torch.cat([gaussians.sh, rest], 1))
    return gaussians, meta


@dataclass(frozen=True)
class Header:
    """What the `meta.json` of a SOG announces.

    meta: the document. count, degree: of the Gaussians. names: of the images of each part. bytes: of all images.
    """

    meta: dict[str, Any]
    count: int
    degree: int
    names: dict[str, list[str]]
    bytes: int


def header(files: sog_files.Files) -> Header:
    """What a SOG announces, which its files and the memory can hold. Raises as `contents`."""
    meta = json.loads(sog_files.contents(files, "meta.json", MAX_META_BYTES))
    version = meta.get("version") if isinstance(meta, dict) else None
    if version != VERSION:
        raise ValueError(
            f"its meta.json says version {version!r:.20}, and only version {VERSION} is read; "
            "splat-transform converts earlier ones"
        )
    count = meta["count"]
    if type(count) is not int or count < 0:
        raise ValueError(f"its count is {count!r:.20}")
    names = _names(meta)
    degree = _degree(meta["shN"]) if "shN" in meta else 0
    size = sum(files.size(name) for part in names.values() for name in part)
    check_gaussians(count, degree, size)
    return Header(meta, count, degree, names, size)


def _antialiased(meta: dict[str, Any]) -> bool | None:
    """What `model` says, or `antialias` of earlier writers where it says nothing known."""
    if isinstance(meta.get("model"), str) and meta["model"] in _MODELS:
        return _MODELS[meta["model"]]
    antialiased = meta.get("antialias")
    return antialiased if isinstance(antialiased, bool) else None


def _names(meta: dict[str, Any]) -> dict[str, list[str]]:
    """The names of the images of each part. Raises ValueError where one of them serves twice."""
    names = {
        part: [str(name) for name in meta[part]["files"]][:images]
        for part, images in _IMAGES.items()
        if part in meta or part != "shN"
    }
    for part, files in names.items():
        if len(files) < _IMAGES[part]:
            raise ValueError(f"its {part} names {len(files)} of {_IMAGES[part]} images")
    every = [name for part in names.values() for name in part]
    twice = sorted({name for name in every if every.count(name) > 1})
    if twice:
        raise ValueError(f"{twice[0][:80]} is named as several of its images, and each is a file of its own")
    return names


def _degree(part: dict[str, Any]) -> int:
    degree = part["bands"]
    if type(degree) is not int or degree not in (1, 2, 3):
        raise ValueError(f"its harmonics have {degree!r:.20} bands")
    return degree


def _check_side(name: str, count: int, other: tuple[int, int] | None, width: int, height: int) -> None:
    """Raise ValueError for an image that cannot be one of `count` Gaussians, beside others of the size `other`."""
    if width * height < count:
        raise ValueError(f"{name[:80]} has {width * height} pixels for {count} Gaussians")
    if width * height > PIXELS_PER_GAUSSIAN * count + MORE_PIXELS:
        raise ValueError(
            f"{name[:80]} has {width} x {height} pixels, far more than its {count} Gaussians need"
        )
    if other not in (None, (width, height)):
        raise ValueError(f"{name[:80]} has {width} x {height} pixels, and the images before it {other}")


def _check_palette(name: str, degree: int, width: int, height: int) -> None:
    pixels = CENTROIDS_PER_ROW * REST_COEFFICIENTS[degree]
    if width != pixels:
        raise ValueError(f"its palette is {width} pixels wide, and degree {degree} needs {pixels}")
    if height > MAX_CENTROIDS // CENTROIDS_PER_ROW:
        raise ValueError(
            f"{name[:80]} has {height} rows of centroids, and labels reach {MAX_CENTROIDS // CENTROIDS_PER_ROW}"
        )


def _means(part: dict[str, Any], lower: Plane, upper: Plane) -> Tensor:
    low, high = (_numbers(part[name], 3) for name in ("mins", "maxs"))
    codes = lower.astype(np.uint16) | (upper.astype(np.uint16) << 8)
    logged = torch.from_numpy(low + (high - low) / 65535 * codes)
    signs = logged.sign()
    return logged.abs_().expm1_().mul_(signs).float()


def _looked_up(part: dict[str, Any], plane: Plane) -> Tensor:
    return torch.from_numpy(_numbers(part["codebook"], 256).astype(np.float32)[plane])


def _read_harmonics(part: dict[str, Any], centroids: Plane, labels: Plane) -> Tensor:
    """The coefficients above the DC term [N, K, 3]. Labels without a centroid give zeros, as in other readers."""
    coefficients = centroids.shape[1] // CENTROIDS_PER_ROW
    book = _numbers(part["codebook"], 256).astype(np.float32)
    entries = book[centroids.reshape(-1, coefficients, 3)]
    index = labels[:, 0].astype(np.int64) + 256 * labels[:, 1].astype(np.int64)
    index = np.where(index < entries.shape[0], index, entries.shape[0])
    entries = np.concatenate([entries, np.zeros((1, coefficients, 3), np.float32)])
    return torch.from_numpy(entries[index])


def _decoded(
    files: sog_files.Files, name: str, most: int, channels: int, check: Callable[[int, int], None]
) -> Plane:
    """The pixels [H, W, channels] of an image of at most `most` bytes.

    check: raises ValueError for a width and height that the image may not have; it is called before it is decoded.
    """
    data = sog_files.contents(files, name, most)
    with guarded.opened_bytes(data, name, FORMATS) as image:
        check(*image.size)
        with guarded.damage(name):
            return np.ascontiguousarray(np.asarray(image.convert("RGBA"))[..., :channels])


def _numbers(values: Any, count: int) -> npt.NDArray[np.float64]:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"its meta.json has a list without {count} finite numbers")
    return numbers
