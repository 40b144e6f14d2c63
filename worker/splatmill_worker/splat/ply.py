"""The standard 3D Gaussian `.ply`: written in one fixed layout, read from any tool's file by property name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from splatmill.files import replacing
from splatmill_worker import ply_header
from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.gaussians import Gaussians

MIN_OPACITY = 1.0 / 255.0
"""Gaussians of less opacity are not written: they cannot change an 8-bit image."""

_DEGREE_OF_REST = {0: 0, 9: 1, 24: 2, 45: 3}
_HEAD_BYTES = 65536
_OPAQUE = 16.0  # logit: 1 - 1e-7, the last opacity under 1 in float32


def property_names(degree: int) -> list[str]:
    """Vertex properties of the standard layout at an SH degree, in file order."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def write(
    path: Path, gaussians: Gaussians, *, degree: int | None = None, comments: tuple[str, ...] = ()
) -> int:
    """Write `gaussians` as binary little-endian float32; returns how many were written.

    Rows with a non-finite parameter and rows with an opacity under MIN_OPACITY are left out. Quaternions are
    normalised. degree: SH degree of the file (some viewers read degree 3 only); that of the Gaussians where None.
    comments: lines of the header.
    The file is replaced atomically and synced.
    """
    if degree is not None:
        gaussians = gaussians.padded(degree)
    gaussians = gaussians.map(lambda value: value.detach().to("cpu", torch.float32))
    gaussians = gaussians.select(
        gaussians.finite() & (torch.sigmoid(gaussians.logit_opacities) >= MIN_OPACITY)
    )
    n = gaussians.count
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1, eps=0.0).float()
    columns = torch.cat(
        [
            gaussians.means,
            torch.zeros(n, 3),
            gaussians.sh[:, 0],
            gaussians.sh[:, 1:].transpose(1, 2).flatten(1),  # channel-major: all R, then all G, then all B
            gaussians.logit_opacities[:, None],
            gaussians.log_scales,
            quats,
        ],
        dim=1,
    )
    names = property_names(gaussians.degree)
    table = (
        np.ascontiguousarray(columns.numpy(), dtype="<f4").view([(name, "<f4") for name in names]).reshape(n)
    )
    document = PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=list(comments))

    with replacing(path, sync=True) as part, part.open("wb") as stream:
        document.write(stream)
    return n


def offset(path: Path) -> tuple[float, float, float]:
    """The offset that `export` subtracted to keep float32 exact: world = file + offset. Zeros where there is none.

    It is a comment of the header. Raises ModelUnreadable where that comment does not hold three numbers.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).partition(b"end_header")[0]
    for line in head.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:2] == ["comment", "offset"]:
            try:
                x, y, z = (float(word) for word in words[2:])
            except ValueError as error:
                raise ModelUnreadable(
                    f"{path.name} has an offset without three numbers in its header: {line!r}."
                ) from error
            return x, y, z
    return 0.0, 0.0, 0.0


def read(path: Path) -> Gaussians:
    """Read any tool's 3D Gaussian `.ply` (binary of either byte order, or text) as float32 tensors.

    Properties are found by name; normals and unknown properties are ignored. Rows with a non-finite value are left
    out. Raises ModelUnreadable for any other file, and FileNotFoundError where there is none.
    """
    try:
        ply_header.check(path)
        document = PlyData.read(str(path))
    except FileNotFoundError:
        raise
    except (PlyParseError, ValueError, OSError, IndexError, KeyError) as error:
        raise ModelUnreadable(f"{path.name} could not be read as a .ply file: {error}") from error
    elements = {element.name: element for element in document.elements}
    if "chunk" in elements:
        raise ModelUnreadable(
            f"{path.name} is a packed (quantised) splat .ply. Convert it to the standard float layout first."
        )
    if "vertex" not in elements:
        raise ModelUnreadable(
            f"{path.name} has no vertex element; its elements are: {', '.join(elements) or 'none'}."
        )
    vertex = elements["vertex"]
    present = [p.name for p in vertex.properties]
    rest = sum(name.startswith("f_rest_") for name in present)
    if rest not in _DEGREE_OF_REST:
        raise ModelUnreadable(
            f"{path.name} has {rest} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45."
        )
    degree = _DEGREE_OF_REST[rest]
    wanted = [name for name in property_names(degree) if name not in ("nx", "ny", "nz")]
    missing = [name for name in wanted if name not in present]
    if missing:
        raise ModelUnreadable(
            f"{path.name} is not a 3D Gaussian .ply: the properties {', '.join(missing)} are missing."
        )

    def columns(*names: str) -> torch.Tensor:
        if not names:
            return torch.zeros(vertex.count, 0)
        return torch.from_numpy(
            np.stack([np.asarray(vertex[name], dtype=np.float32) for name in names], axis=1)
        )

    rest_columns = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(vertex.count, 3, rest // 3)
    gaussians = Gaussians(
        means=columns("x", "y", "z"),
        log_scales=columns("scale_0", "scale_1", "scale_2"),
        quats=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        # Some tools write an opacity of exactly 1 or 0 as its infinite logit.
        logit_opacities=columns("opacity")[:, 0].contiguous().clamp(-_OPAQUE, _OPAQUE),
        sh=torch.cat([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest_columns.transpose(1, 2)], dim=1),
    )
    keep = gaussians.finite()
    return gaussians if bool(keep.all()) else gaussians.select(keep)
