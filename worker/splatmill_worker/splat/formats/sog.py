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
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from splatmill.files import replacing
from splatmill_worker.errors import ModelUnreadable, UnusablePicture
from splatmill_worker.images import guarded
from splatmill_worker.images.archive import DAMAGED
from splatmill_worker.splat.formats import palette
from splatmill_worker.splat.formats.contents import (
    NO_OFFSET,
    Contents,
    Offset,
    finite,
    logits,
    unit,
    visible,
)
from splatmill_worker.splat.formats.morton import morton_order
from splatmill_worker.splat.gaussians import REST_COEFFICIENTS, Gaussians

VERSION = 2
CENTROIDS_PER_ROW = 64
"""Centroids in a row of `shN_centroids.webp`, by the specification."""

MAX_CENTROIDS = 65536
"""A label has 16 bits."""

GAUSSIANS_PER_CENTROID = 10
LEAST_CENTROIDS, MOST_CENTROIDS = 1024, 8192
"""Bounds on the number of centroids; between them, a centroid stands for GAUSSIANS_PER_CENTROID (decisions: sog)."""

_ENCRYPTED = 1
"""The bit of a zip member's flags that says so."""

MAX_META_BYTES = 2**24
MAX_IMAGE_BYTES = 2**30
"""Bytes of a member of the archive after inflation; the images are stored as they are."""

Plane = npt.NDArray[np.uint8]

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
    count = gaussians.count
    shown = importance(gaussians)
    logged = gaussians.means.double()
    logged = logged.sign() * logged.abs().log1p()
    low = logged.amin(0) if count else logged.new_zeros(3)
    high = logged.amax(0) if count else logged.new_zeros(3)
    codes = ((logged - low) / (high - low).clamp(min=1e-300) * 65535).round().clamp(0, 65535).long()
    order = morton_order(logged)
    gaussians, codes, shown = gaussians.select(order), codes[order], shown[order]

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
    with (
        replacing(path, sync=True) as part,
        zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive,
    ):
        archive.writestr(_member("meta.json"), json.dumps(meta))
        for name, plane in images.items():
            archive.writestr(_member(name), _encoded(plane))
    return count


def read(path: Path) -> Contents:
    """Read a `.sog` archive, or the `meta.json` of one that lies unpacked beside its images.

    Raises ModelUnreadable for any other file and for earlier versions, and FileNotFoundError where there is none.
    """
    try:
        with _files(path) as file:
            return _contents(file)
    except FileNotFoundError:
        raise
    except UnusablePicture as error:
        raise ModelUnreadable(f"{path.name} cannot be read: {error.message}") from error
    except RecursionError as error:
        raise ModelUnreadable(
            f"{path.name} could not be read as a SOG model: its meta.json nests too many objects or lists"
        ) from error
    except (*DAMAGED, OSError, ValueError, OverflowError, KeyError, TypeError) as error:
        raise ModelUnreadable(f"{path.name} could not be read as a SOG model: {_said(error)}") from error


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
    wanted = min(max(count // GAUSSIANS_PER_CENTROID, LEAST_CENTROIDS), MOST_CENTROIDS)
    return -(-wanted // CENTROIDS_PER_ROW) * CENTROIDS_PER_ROW


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
    largest = torch.from_numpy(plane[:, 3].astype(np.int64)) - 252
    if plane.shape[0] and not bool((largest >= 0).all()):
        raise ValueError("quats.webp has alpha values under 252")
    small = (torch.from_numpy(plane[:, :3].astype(np.float64)) / 255 * 2 - 1) * _ROOT_HALF
    full = (1 - small.square().sum(1, keepdim=True)).clamp(min=0).sqrt()
    quats = torch.zeros(plane.shape[0], 4, dtype=torch.float64)
    return quats.scatter(1, largest[:, None], full).scatter(1, _OTHERS[largest], small).float()


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


def _encoded(plane: Plane) -> bytes:
    stream = io.BytesIO()
    # exact: by default the colour under an alpha of 0 is not kept. The quality is an effort here: the highest took
    # thirty times as long for as many bytes (decisions: sog).
    Image.fromarray(plane).save(stream, "WEBP", lossless=True, quality=40, method=2, exact=True)
    return stream.getvalue()


def _member(name: str) -> zipfile.ZipInfo:
    """The same bytes for the same model: without the time."""
    return zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))


@contextmanager
def _files(path: Path) -> Iterator[Callable[[str, int], bytes]]:
    """A function from a file's name and largest size to its bytes. Raises ValueError for one out of bounds."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:

            def of_archive(name: str, most: int) -> bytes:
                member = archive.getinfo(name)
                if member.file_size > most:
                    raise ValueError(f"{name[:80]} has more than {most} bytes")
                if member.flag_bits & _ENCRYPTED:
                    raise ValueError(f"{name[:80]} is encrypted")
                return archive.read(name)

            yield of_archive
        return

    def beside(name: str, most: int) -> bytes:
        if PurePosixPath(name).name != name:
            raise ValueError(f"meta.json names a file outside of its folder: {name[:80]!r}")
        found = path if name == "meta.json" else path.with_name(name)
        if found.stat().st_size > most:
            raise ValueError(f"{name[:80]} has more than {most} bytes")
        return found.read_bytes()

    yield beside


def _contents(file: Callable[[str, int], bytes]) -> Contents:
    meta = json.loads(file("meta.json", MAX_META_BYTES))
    version = meta.get("version") if isinstance(meta, dict) else None
    if version != VERSION:
        raise ValueError(
            f"its meta.json says version {version!r:.20}, and only version {VERSION} is read; "
            "splat-transform converts earlier ones"
        )
    count = meta["count"]
    if type(count) is not int or count < 0:
        raise ValueError(f"its count is {count!r:.20}")

    def plane(part: str, index: int, channels: int) -> Plane:
        return _decoded(file, meta[part]["files"][index], channels)

    def rows(part: str, index: int, channels: int) -> Plane:
        pixels = plane(part, index, channels).reshape(-1, channels)
        if pixels.shape[0] < count:
            raise ValueError(
                f"{meta[part]['files'][index][:80]} has {pixels.shape[0]} pixels for {count} Gaussians"
            )
        return pixels[:count]

    low, high = (_numbers(meta["means"][name], 3) for name in ("mins", "maxs"))
    codes = rows("means", 0, 3).astype(np.float64) + 256.0 * rows("means", 1, 3).astype(np.float64)
    logged = torch.from_numpy(low + (high - low) * codes / 65535)
    colors = rows("sh0", 0, 4)
    dc = _numbers(meta["sh0"]["codebook"], 256)[colors[:, :3]]
    scales = _numbers(meta["scales"]["codebook"], 256)[rows("scales", 0, 3)]
    sh = torch.from_numpy(dc)[:, None].float()
    if "shN" in meta:
        sh = torch.cat([sh, _read_harmonics(meta["shN"], plane("shN", 0, 3), rows("shN", 1, 3))], 1)
    gaussians = Gaussians(
        means=(logged.sign() * logged.abs().expm1()).float(),
        log_scales=torch.from_numpy(scales).float(),
        quats=_unpacked(rows("quats", 0, 4)),
        logit_opacities=logits(torch.from_numpy(colors[:, 3].astype(np.float32)) / 255),
        sh=sh,
    )
    offset = NO_OFFSET
    if isinstance(meta.get("splatmill"), dict):
        x, y, z = _numbers(meta["splatmill"]["offset"], 3).tolist()
        offset = (x, y, z)
    antialiased = meta.get("antialias")
    return Contents(
        finite(gaussians),
        offset,
        antialiased if isinstance(antialiased, bool) else None,
    )


def _read_harmonics(part: dict[str, Any], centroids: Plane, labels: Plane) -> Tensor:
    """The coefficients above the DC term [N, K, 3]. Labels without a centroid give zeros, as in other readers."""
    degree = part["bands"]
    if degree not in (1, 2, 3):
        raise ValueError(f"its harmonics have {degree!r:.20} bands")
    coefficients = REST_COEFFICIENTS[degree]
    if centroids.shape[1] != CENTROIDS_PER_ROW * coefficients:
        raise ValueError(
            f"its palette is {centroids.shape[1]} pixels wide, and {coefficients} coefficients need "
            f"{CENTROIDS_PER_ROW * coefficients}"
        )
    book = _numbers(part["codebook"], 256).astype(np.float32)
    entries = book[centroids.reshape(-1, coefficients, 3)]
    index = labels[:, 0].astype(np.int64) + 256 * labels[:, 1].astype(np.int64)
    index = np.where(index < entries.shape[0], index, entries.shape[0])
    entries = np.concatenate([entries, np.zeros((1, coefficients, 3), np.float32)])
    return torch.from_numpy(entries[index])


def _decoded(file: Callable[[str, int], bytes], name: str, channels: int) -> Plane:
    with (
        guarded.opened_bytes(file(name, MAX_IMAGE_BYTES), name, ("WEBP", "PNG")) as image,
        guarded.damage(name),
    ):
        return np.asarray(image.convert("RGBA"))[..., :channels]


def _numbers(values: Any, count: int) -> npt.NDArray[np.float64]:
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"its meta.json has a list without {count} finite numbers")
    return numbers


def _said(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"{error.args[0]!r:.100} is missing"
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
