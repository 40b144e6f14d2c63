"""Binary glTF 2.0 with the extension KHR_gaussian_splatting: a primitive of points whose attributes are all float32.

Source: Khronos, glTF 2.0, section 4.4 (binary files), and KHR_gaussian_splatting ("Complete, Ratified by the Khronos
Group"). Scales are linear and opacities from 0 to 1 there; earlier drafts had logarithmic scales.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers.reader_memory import check, check_gaussians
from splatmill_worker.splat.formats import gltf
from splatmill_worker.splat.formats.contents import (
    NO_OFFSET,
    Contents,
    Offset,
    logits,
    unit,
    visible,
)
from splatmill_worker.splat.formats.frames import turned_about_x
from splatmill_worker.splat.formats.ply_columns import rest_notes
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.wording import plain

EXTENSION = "KHR_gaussian_splatting"
DRAWN = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
"""How the Gaussians of a primitive are drawn, in the words of the extension."""

MAX_JSON_BYTES = 2**22
"""Bytes of the document, which has some ten kilobytes; Python takes up to thirty times as many to parse it."""

_POINTS = 0
Array = npt.NDArray[np.generic]


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    up: gltf.Up | None = None,
) -> int:
    """Write `gaussians` as a `.glb` in the frame of glTF (y up); returns how many were written.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out. The colours of degree 0
    are stored a second time, as COLOR_0, for programs that show points only. offset, antialiased: of `Contents`, in the
    `extras` of the primitive. up: as of `gltf.node`. The file is replaced atomically and synced. Raises ValueError for
    4 GiB or more.
    """
    turned = turned_about_x(visible(gaussians))
    parts = gltf.Parts()
    attributes = {
        "POSITION": parts.add(turned.means.numpy(), bounds=True),
        "COLOR_0": parts.add(_point_colors(turned), normalized=True),
        f"{EXTENSION}:ROTATION": parts.add(unit(turned.quats).roll(-1, 1).numpy()),
        f"{EXTENSION}:SCALE": parts.add(turned.log_scales.exp().numpy()),
        f"{EXTENSION}:OPACITY": parts.add(torch.sigmoid(turned.logit_opacities)[:, None].numpy()),
    }
    for index, (degree, order) in enumerate(harmonics(turned.degree)):
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = parts.add(turned.sh[:, index].numpy())
    primitive = {
        "mode": _POINTS,
        "attributes": attributes,
        "extensions": {EXTENSION: DRAWN},
        "extras": {"antialiased": antialiased} | ({"offset": offset} if any(offset) else {}),
    }
    document: dict[str, Any] = {
        "asset": gltf.ASSET,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if turned.count else []}],
    }
    if turned.count:  # glTF has no accessors of nothing
        document |= {"nodes": [gltf.node(up)], "meshes": [{"primitives": [primitive]}]} | parts.document()
    gltf.write(path, document, parts if turned.count else None, f"{turned.count} Gaussians")
    return turned.count


def read(path: Path) -> Contents:
    """Read the Gaussians of a `.glb`: one primitive of points, float or quantised, whose node leaves it in place.

    A rotation by which Splatmill has set it upright is not applied: the model keeps the frame of its cameras.

    Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    try:
        return _contents(path)
    except FileNotFoundError:
        raise
    except (
        ValueError,
        OverflowError,
        OSError,
        TypeError,
        IndexError,
        struct.error,
        AttributeError,
        KeyError,
        RecursionError,
    ) as error:
        raise ModelUnreadable(
            f"{path.name} could not be read as a .glb of Gaussians: {plain(error)}."
        ) from error


def harmonics(degree: int) -> Iterator[tuple[int, int]]:
    """Degree of each coefficient in the order of the `.ply`, and its place within it, from the lowest order up."""
    for each in range(degree + 1):
        for order in range(2 * each + 1):
            yield each, order


def _point_colors(gaussians: Gaussians) -> Array:
    """Linear colour and opacity as bytes [N, 4]: COLOR_0 is linear, and the harmonics give sRGB values."""
    shown = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1).numpy()
    alpha = torch.sigmoid(gaussians.logit_opacities)[:, None].numpy()
    return (np.concatenate([gltf.linear(shown), alpha], 1) * 255).round().astype(np.uint8)


def _contents(path: Path) -> Contents:
    document, data = _chunks(path)
    primitives = [
        (index, primitive)
        for index, mesh in enumerate(document.get("meshes", []))
        for primitive in mesh["primitives"]
        if EXTENSION in primitive.get("extensions", {})
    ]
    if len(primitives) != 1:
        raise ValueError(f"it has {len(primitives)} primitives with {EXTENSION}, and one is read")
    mesh, primitive = primitives[0]
    _check(primitive)
    attributes = primitive["attributes"]

    degree = max(d for d in range(4) if f"{EXTENSION}:SH_DEGREE_{d}_COEF_0" in attributes)
    count = document["accessors"][attributes["POSITION"]]["count"]
    if type(count) is not int:
        raise ValueError(f"its POSITION has {count!r:.20} values")
    check_gaussians(count, degree, path.stat().st_size)
    means = _accessor(document, data, attributes["POSITION"], 3, "POSITION", count)

    def values(name: str, width: int) -> Tensor:
        return _accessor(document, data, attributes[name], width, name, count)

    sh = [values(f"{EXTENSION}:SH_DEGREE_{d}_COEF_{order}", 3) for d, order in harmonics(degree)]
    scales = values(f"{EXTENSION}:SCALE", 3)
    if bool((scales < 0).any()):
        raise ValueError(
            "it has negative scales, as drafts of the extension had with logarithms; they are linear"
        )
    opacities = values(f"{EXTENSION}:OPACITY", 1)[:, 0]
    if not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise ValueError("it has opacities outside of 0 to 1")
    gaussians = Gaussians(
        means=means,
        log_scales=scales.clamp(min=1e-30).log(),
        quats=values(f"{EXTENSION}:ROTATION", 4).roll(1, 1),
        logit_opacities=logits(opacities),
        sh=torch.stack(sh, 1),
    )
    _check_node(document, mesh)
    extras = primitive.get("extras")
    extras = extras if isinstance(extras, dict) else {}
    x, y, z = (float(value) for value in extras.get("offset", NO_OFFSET))
    antialiased = extras.get("antialiased")
    return Contents.of(
        turned_about_x(gaussians),
        (x, y, z),
        antialiased if isinstance(antialiased, bool) else None,
        rest_notes(4 if f"{EXTENSION}:SH_DEGREE_4_COEF_0" in attributes else degree),
    )


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk. Raises ValueError for files that are no binary glTF 2.0."""
    with path.open("rb") as file:
        magic, version, total = struct.unpack("<4sII", file.read(12))
        if magic != gltf.MAGIC or version != gltf.VERSION:
            raise ValueError(f"it does not begin as binary glTF {gltf.VERSION}")
        if total > path.stat().st_size:
            raise ValueError(f"its header announces {total} bytes, and it has {path.stat().st_size}")
        length, kind = struct.unpack("<I4s", file.read(8))
        if kind != gltf.JSON or length > min(total, MAX_JSON_BYTES):
            raise ValueError("its first chunk is no JSON document of a plausible size")
        document = json.loads(file.read(length))
        if not isinstance(document, dict):
            raise ValueError("its JSON chunk is no object")
        head = file.read(8)
        if not head:
            return document, b""
        length, kind = struct.unpack("<I4s", head)
        if kind != gltf.BIN or length > total:
            raise ValueError("its second chunk is not its binary data")
        check("reading it", length, total)
        data = file.read(length)
    if len(data) != length:
        raise ValueError(f"its binary chunk announces {length} bytes, and {len(data)} follow")
    return document, data


def _check(primitive: dict[str, Any]) -> None:
    extension = primitive["extensions"][EXTENSION]
    if primitive.get("mode") != _POINTS:
        raise ValueError(
            f"its primitive has the mode {primitive.get('mode')!r:.20}, and points have {_POINTS}"
        )
    if extension.get("kernel") != "ellipse":
        raise ValueError(f"its kernel is {extension.get('kernel')!r:.60}, and only 'ellipse' is read")
    if extension.get("colorSpace") != "srgb_rec709_display":
        raise ValueError(
            f"its colours are in {extension.get('colorSpace')!r:.60}, and only 'srgb_rec709_display' is read"
        )
    if extension.get("extensions"):
        raise ValueError(f"its Gaussians need {', '.join(extension['extensions'])[:100]}, which is not read")


def _accessor(
    document: dict[str, Any], data: bytes, index: int, width: int, name: str, expected: int
) -> Tensor:
    """The values [N, width] of an accessor, float32.

    Raises ValueError where N is not `expected`, and where it leaves the binary chunk.
    """
    accessor = document["accessors"][index]
    if accessor["count"] != expected:
        raise ValueError(f"{name} has {accessor['count']!r:.20} values, and POSITION {expected!r:.20}")
    if accessor.get("sparse") is not None or gltf.TYPES.get(accessor["type"]) != width:
        raise ValueError(f"the accessor of {name} is sparse or no {width} values")
    view = document["bufferViews"][accessor["bufferView"]]
    if view.get("buffer") != 0 or "uri" in document["buffers"][0]:
        raise ValueError(f"the values of {name} are not in the file itself")
    kind, divisor = gltf.COMPONENTS[accessor["componentType"]]
    row = np.dtype((kind, (width,)))
    count, stride = accessor["count"], view.get("byteStride", row.itemsize)
    begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if (
        min(count, begin) < 0
        or stride < row.itemsize
        or begin + (count - 1) * stride + row.itemsize > len(data)
    ):
        raise ValueError(f"the values of {name} are outside of its binary data")
    array: Array = np.ndarray((count, width), kind, data, begin, (stride, row.itemsize // width))
    values = torch.from_numpy(array.astype(np.float32))
    return (values / divisor).clamp(min=-1) if accessor.get("normalized") else values


def _check_node(document: dict[str, Any], mesh: int) -> None:
    """Raise ValueError where the Gaussians are not as they are in the scene: moved by their node or within another."""
    nodes = document.get("nodes", [])
    holders = [node for node in nodes if node.get("mesh") == mesh]
    if len(holders) != 1 or any(node.get("children") for node in nodes):
        raise ValueError("its Gaussians are not in one node without a parent")
    moves = {"translation", "rotation", "scale", "matrix"} & holders[0].keys()
    if moves and not (moves == {"rotation"} and holders[0].get("extras") == gltf.UPRIGHT):
        raise ValueError("its node moves, turns or scales the Gaussians, which is not read")
