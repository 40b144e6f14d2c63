"""Compile every kernel for a GPU that need not be there, and read registers, spills and shared memory from
the binary.

`python -m splatmill_worker.kernels.gpu.compiled 80 90` prints one JSON line per kernel, setting and
architecture; with --first only of the setting that is used where nothing was measured.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from . import adam, bin, composite, composite_backward, knn, loss, project, project_backward, step
from .blended import SEGMENT

FLOATS = "*fp32"
TYPES = {
    "offsets": "*i64", "ids": "*i32", "first_segment": "*i32", "segment_tile": "*i32", "photo": "*u8", "mask": "*u8",
    "order": "*i32", "counts": "*i64", "ends": "*i64", "keys": "*i16", "visible": "*i64", "room": "i32", "seen": "*u8",
    "last_step": "*i32", "refused": "*i32", "count": "i32", "stride": "i32", "width": "i32", "height": "i32",
    "columns": "i32", "rows": "i32", "step": "i32", "near": "fp32", "weight": "fp32", "rate": "fp32", "size": "fp32",
    "root": "fp32", "nearest": "fp32", "channels": "i32", "half_width": "fp32", "half_height": "fp32",
    "per_image": "fp32", "means_rate": "fp32", "scales_rate": "fp32", "quats_rate": "fp32", "opacity_rate": "fp32",
    "dc_rate": "fp32", "rest_rate": "fp32",
}  # fmt: skip
"""Type of every argument that is not a float32 array, by the name it has in all kernels."""

SCALARS = {"i32", "i64", "fp32"}


@dataclass(frozen=True)
class Variant:
    """One kernel with the constants that the product launches it with; the autotuner's settings come on
    top.
    """

    kernel: Any
    constants: dict[str, Any]
    settings: tuple[triton.Config, ...] | None = None  # of kernels that are not autotuned


@dataclass(frozen=True)
class Compiled:
    """What the assembler said of one kernel."""

    kernel: str
    setting: str
    architecture: int
    registers: int
    spilled: int  # bytes of stack per thread
    shared: int  # bytes per program


def variants() -> Iterator[Variant]:
    """Every kernel as a training step and a rendering launch it."""
    flat = {"COEFFICIENTS": 16, "USED": 16, "ANTIALIAS": False}
    for planar in (True, False):
        yield Variant(project.project_kernel, {**flat, "PLANAR": planar})
    coefficients = {"COEFFICIENTS": 16, "USED": 16, "PLANAR": True}
    yield Variant(project_backward.color_backward_kernel, coefficients)
    shape = {"ANTIALIAS": False}
    yield Variant(
        project_backward.shape_backward_kernel, {**shape, "PLANAR": True, "VIEWMAT": False, "d_viewmat": None}
    )
    yield Variant(project_backward.shape_backward_kernel, {**shape, "PLANAR": False, "VIEWMAT": True})
    lists = {"BLOCK": bin.BLOCK, "LANES": bin.LANES}
    warps = (triton.Config({}, num_warps=4),)
    yield Variant(
        bin.pairs_kernel, {**lists, "WRITE": False, "ends": None, "keys": None, "ids": None}, settings=warps
    )
    yield Variant(bin.pairs_kernel, {**lists, "WRITE": True}, settings=warps)
    walk = {"SEGMENT": SEGMENT, "BACKGROUND": True}
    nothing = {"depth": None, "checkpoints": None, "first_segment": None, "segment_tile": None}
    yield Variant(composite.composite_kernel, {**walk, **nothing, "DEPTH": False, "CHECKPOINTS": False})
    yield Variant(composite.composite_kernel, {**walk, "DEPTH": False, "CHECKPOINTS": True, "depth": None})
    back = {"SEGMENT": SEGMENT}
    yield Variant(
        composite_backward.composite_backward_kernel,
        {
            **back,
            "ALPHA": False,
            "DEPTH": False,
            "SCORES": True,
            "d_alpha": None,
            "d_depth": None,
            "depth": None,
        },
    )
    yield Variant(
        composite_backward.composite_backward_kernel,
        {**back, "ALPHA": True, "DEPTH": True, "SCORES": False},
    )
    bare, photo = {"MASK": False, "mask": None}, {"mean": None, "variance": None}
    yield Variant(loss.across_kernel, {**bare, "STATS": True})
    yield Variant(loss.across_kernel, {"MASK": True, "STATS": False})
    yield Variant(loss.value_kernel, {**bare, "STATS": True, "SLOPES": True})
    yield Variant(loss.value_kernel, {**photo, "MASK": True, "STATS": False, "SLOPES": True})
    yield Variant(loss.down_kernel, {})
    yield Variant(loss.gradient_kernel, bare)
    yield Variant(step.scores_kernel, {"BLOCK": 256}, settings=warps)
    yield Variant(adam.planes_kernel, {"BLOCK": adam.BLOCK}, settings=warps)
    yield Variant(adam.drift_kernel, {"BLOCK": adam.BLOCK}, settings=warps)
    yield Variant(adam.adam_kernel, {"CHANNELS": 3, "VISIBLE": True, "BLOCK": 4 * adam.BLOCK}, settings=warps)
    yield Variant(knn.knn_kernel, {"ROWS": knn.ROWS, "OTHERS": knn.OTHERS}, settings=warps)


def compile_variant(variant: Variant, setting: triton.Config, architecture: int) -> Compiled:
    """Compile one kernel down to the binary of `architecture` (80 is sm_80), aligned pointers assumed as
    at a launch.
    """
    function = variant.kernel.fn if hasattr(variant.kernel, "configs") else variant.kernel
    constants = {**variant.constants, **setting.kwargs}
    signature, attributes = {}, {}
    for position, name in enumerate(function.arg_names):
        kind = TYPES.get(name, FLOATS)
        signature[name] = "constexpr" if name in constants else kind
        if name not in constants and kind not in SCALARS:
            attributes[(position,)] = [["tt.divisibility", 16]]
    made = triton.compile(
        ASTSource(function, signature, constants, attributes),
        target=GPUTarget("cuda", architecture, 32),
        options={"num_warps": setting.num_warps, "num_stages": setting.num_stages},
    )
    registers, spilled = resources(made.asm["cubin"])
    chosen = ", ".join(
        f"{k}={v}" for k, v in {**variant.constants, **setting.all_kwargs()}.items() if v is not None
    )
    return Compiled(function.__name__, chosen, architecture, registers, spilled, made.metadata.shared)


def resources(binary: bytes) -> tuple[int, int]:
    """Registers and stack bytes per thread, as cuobjdump reads them from a binary."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(binary)
        file.flush()
        tool = triton.knobs.nvidia.cuobjdump.path
        told = subprocess.run(
            [tool, "-res-usage", file.name], capture_output=True, text=True, check=True
        ).stdout
    found = re.search(r"REG:(\d+) STACK:(\d+)", told)
    if found is None:
        raise RuntimeError(f"cuobjdump -res-usage said nothing of registers: {told!r}")
    return int(found[1]), int(found[2])


def settings(variant: Variant) -> tuple[triton.Config, ...]:
    """What the autotuner would choose from."""
    return variant.settings or tuple(variant.kernel.configs)


def main(arguments: list[str]) -> None:
    if os.environ.get("TRITON_INTERPRET") == "1":
        raise SystemExit("TRITON_INTERPRET=1 replaces the compiler; unset it to compile.")
    first = "--first" in arguments
    for architecture in [int(x) for x in arguments if x.isdigit()] or [80, 90]:
        for variant in variants():
            for setting in settings(variant)[: 1 if first else None]:
                print(json.dumps(asdict(compile_variant(variant, setting, architecture))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
