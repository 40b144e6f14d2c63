"""The parameters of Gaussians among the vertex properties of a `.ply`, as several programs write them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from plyfile import PlyElement
from torch import Tensor

from splatmill_worker.splat.formats.contents import OPAQUE
from splatmill_worker.splat.gaussians import REST_COEFFICIENTS, SH_C0, Gaussians

FLATNESS = 1e-3
"""Thickness of a Gaussian of two scales, over the smaller of them."""

_LARGEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
"""The brightest value of a colour, by the type of its property."""

_CHANNELS = ("red", "green", "blue")
_MOST_COEFFICIENTS = REST_COEFFICIENTS[3]


def degree_of(rest: int) -> int | None:
    """The degree of harmonics with `rest` coefficients beyond the colours; None where there is none."""
    degree = math.isqrt(rest // 3 + 1) - 1
    return degree if rest == 3 * ((degree + 1) ** 2 - 1) else None


def kept_rest(rest: int) -> list[str]:
    """The names of the `rest` coefficients of a file up to degree 3: all of red, then of green, then of blue."""
    each = rest // 3
    return [
        f"f_rest_{channel * each + i}" for channel in range(3) for i in range(min(each, _MOST_COEFFICIENTS))
    ]


def rest_notes(degree: int) -> tuple[str, ...]:
    """The note on harmonics of `degree`: those above 3 are not read."""
    return (f"Its harmonics of degree {degree} are read to degree 3.",) if degree > 3 else ()


def gaussians_of(vertex: PlyElement) -> tuple[Gaussians, tuple[str, ...]]:
    """The Gaussians, and sentences about what is read otherwise than it stands there, or not at all.

    Raises ValueError where properties are missing or of unknown meaning; `degree_of` their coefficients is not None.
    """
    present = {p.name for p in vertex.properties}
    rest = sum(name.startswith("f_rest_") for name in present)
    by_channel = "f_dc_0" not in present and present >= set(_CHANNELS)
    colors = _CHANNELS if by_channel else ("f_dc_0", "f_dc_1", "f_dc_2")
    flat = "scale_2" not in present and present >= {"scale_0", "scale_1"}
    scales = ("scale_0", "scale_1") if flat else ("scale_0", "scale_1", "scale_2")
    quats = ("rot_0", "rot_1", "rot_2", "rot_3")
    every = ("x", "y", "z", *colors, *(f"f_rest_{i}" for i in range(rest)), "opacity", *scales, *quats)
    missing = [name for name in every if name not in present]
    if missing:
        no_gaussians = {"x", "y", "z"} <= present and not present & {"opacity", *scales, *quats}
        what = "; it holds points alone, a cloud or a mesh" if no_gaussians else ""
        raise ValueError(f"the properties {', '.join(missing)} are missing{what}")

    notes = rest_notes(degree_of(rest) or 0)
    if by_channel:
        notes += ("Its colours are those of red, green and blue, as it has no f_dc.",)
    if flat:
        notes += ("It has no scale_2, as models of 2D Gaussians: its Gaussians are read as flat ones.",)
    log_scales = _columns(vertex, scales)
    if flat:
        thin = log_scales.amin(dim=1, keepdim=True) + math.log(FLATNESS)
        log_scales = torch.cat([log_scales, thin], dim=1)
    dc = (_shown(vertex) - 0.5) / SH_C0 if by_channel else _columns(vertex, colors)
    names = kept_rest(rest)
    sh = np.empty((vertex.count, 1 + len(names) // 3, 3), np.float32)
    sh[:, 0] = dc.numpy()
    for place, name in enumerate(names):
        sh[:, 1 + place % (len(names) // 3), place // (len(names) // 3)] = vertex[name]
    gaussians = Gaussians(
        means=_columns(vertex, ("x", "y", "z")),
        log_scales=log_scales,
        quats=_columns(vertex, quats),
        # Some tools write an opacity of exactly 1 or 0 as its infinite logit.
        logit_opacities=_columns(vertex, ("opacity",))[:, 0].contiguous().clamp(-OPAQUE, OPAQUE),
        sh=torch.from_numpy(sh),
    )
    return gaussians, notes


def _columns(vertex: PlyElement, names: Sequence[str]) -> Tensor:
    return torch.from_numpy(np.stack([np.asarray(vertex[name], np.float32) for name in names], axis=1))


def _shown(vertex: PlyElement) -> Tensor:
    """The colours [N, 3] of red, green and blue, 0 to 1. Raises ValueError for those that can be read in two ways."""
    kinds = sorted({vertex[channel].dtype.str.lstrip("<>|=") for channel in _CHANNELS})
    if len(kinds) != 1 or kinds[0] not in _LARGEST:
        raise ValueError(
            f"red, green and blue are of the types {', '.join(kinds)}; colours are uchar up to 255, ushort up to "
            "65535, or float up to 1"
        )
    colors = _columns(vertex, _CHANNELS) / _LARGEST[kinds[0]]
    finite = colors[colors.isfinite()]
    if finite.numel() and bool((finite != finite.clamp(0, 1)).any()):
        raise ValueError(
            f"red, green and blue are floats from {float(finite.min()):g} to {float(finite.max()):g}: those from 0 "
            "to 1 are read, and it is not known whether these reach up to 255"
        )
    return colors
