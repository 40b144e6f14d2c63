"""Compile every kernel for a GPU that need not be present, and read registers, spills and shared memory off the binary.

`python -m splatmill_worker.kernels.gpu.compiled 80 90` prints one JSON line per kernel, launch setting and
architecture (80 is sm_80). With --first it compiles each kernel only in the setting used where nothing was measured.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, make_backend
from triton.runtime.jit import create_function_from_signature

from . import (
    adam,
    bin,
    composite,
    composite_backward,
    knn,
    loss,
    median_depth,
    photos,
    project,
    project_backward,
    step,
)
from .blended import SEGMENT
from .launch.argument import declared


@dataclass(frozen=True)
class Variant:
    """One kernel with constants that a render or a training step launches it with.

    kernel: the function under `triton.jit`, autotuned or not.
    constants: by argument name, those of the launch; None for arrays that it leaves out.
    settings: launch settings of a kernel that is not autotuned; None takes those of the autotuner.
    types: those of arguments that are not always passed as declared.
    """

    kernel: Any
    constants: dict[str, Any]
    settings: tuple[triton.Config, ...] | None = None
    types: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Compiled:
    """What the assembler reports of one compiled kernel.

    kernel: its name.
    setting: its constants and launch setting, for a reader.
    architecture: 80 for sm_80.
    registers: per thread.
    spilled: bytes of stack per thread.
    shared: bytes of shared memory per program.
    """

    kernel: str
    setting: str
    architecture: int
    registers: int
    spilled: int
    shared: int


def variants() -> Iterator[Variant]:
    """Yield every kernel with the constants of the training step, of rendering and of the separate ops."""
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
    yield Variant(bin.compact_kernel, {"BLOCK": bin.COMPACT_BLOCK}, settings=warps)
    yield Variant(
        bin.pairs_kernel, {**lists, "WRITE": False, "ends": None, "keys": None, "ids": None}, settings=warps
    )
    yield Variant(bin.pairs_kernel, {**lists, "WRITE": True}, settings=warps)
    yield Variant(bin.pairs_kernel, {**lists, "WRITE": True}, settings=warps, types={"keys": "*i32"})
    walk = {"SEGMENT": SEGMENT, "BACKGROUND": True}
    nothing = {"depth": None, "checkpoints": None, "first_segment": None, "segment_tile": None}
    yield Variant(composite.composite_kernel, {**walk, **nothing, "WITH_DEPTH": False, "CHECKPOINTS": False})
    yield Variant(
        composite.composite_kernel, {**walk, "WITH_DEPTH": False, "CHECKPOINTS": True, "depth": None}
    )
    color_alone = {"WITH_ALPHA": False, "WITH_DEPTH": False, "d_alpha": None, "d_depth": None, "depth": None}
    for back in (color_alone, {"WITH_ALPHA": True, "WITH_DEPTH": True}):
        yield Variant(composite_backward.composite_backward_kernel, {**back, "SEGMENT": SEGMENT})
    bare = {"MASK": False, "mask": None}
    for masked in (bare, {"MASK": True}):
        yield Variant(loss.row_stats_kernel, masked)
        yield Variant(loss.across_kernel, masked)
        yield Variant(loss.value_kernel, {**masked, "SLOPES": True})
    yield Variant(loss.stats_kernel, {})
    yield Variant(loss.down_kernel, {})
    yield Variant(loss.gradient_kernel, bare)
    yield Variant(loss.total_kernel, {"BLOCK": loss.TOTAL_BLOCK}, settings=warps)
    yield Variant(photos.over_kernel, {"BLOCK": photos.BLOCK, "BACKGROUND": True}, settings=warps)
    yield Variant(step.scores_kernel, {"BLOCK": step.SCORES_BLOCK}, settings=warps)
    yield Variant(adam.planes_kernel, {"BLOCK": adam.BLOCK}, settings=warps)
    yield Variant(adam.drift_kernel, {"BLOCK": adam.BLOCK}, settings=warps)
    two = (triton.Config({}, num_warps=2),)
    yield Variant(median_depth.median_depth_kernel, {}, settings=two)
    yield Variant(knn.knn_kernel, {"ROWS": knn.ROWS, "OTHERS": knn.OTHERS}, settings=warps)


def compile_variant(variant: Variant, setting: triton.Config, architecture: int) -> Compiled:
    """Compile one kernel for `architecture`, with arrays aligned to 16 bytes, as torch allocates them.

    Raises KeyError for an argument without a declared type (`argument`), and TypeError where a launch could not pass
    the arguments on.
    """
    function = variant.kernel.fn if hasattr(variant.kernel, "configs") else variant.kernel
    constants = {**variant.constants, **setting.kwargs}
    signature, attributes = {}, {}
    for position, name in enumerate(function.arg_names):
        if name in constants:
            signature[name] = "constexpr"
            continue
        signature[name] = variant.types.get(name) or declared(function, name)
        if signature[name].startswith("*"):
            attributes[(position,)] = [["tt.divisibility", 16]]
    target = GPUTarget("cuda", architecture, 32)
    _bind(function, signature, constants, target)
    made = triton.compile(
        ASTSource(function, signature, constants, attributes),
        target=target,
        options={"num_warps": setting.num_warps, "num_stages": setting.num_stages},
    )
    registers, spilled = resources(made.asm["cubin"])
    chosen = ", ".join(
        f"{k}={v}" for k, v in {**variant.constants, **setting.all_kwargs()}.items() if v is not None
    )
    return Compiled(function.__name__, chosen, architecture, registers, spilled, made.metadata.shared)


def _bind(
    function: triton.JITFunction[..., None],
    signature: dict[str, str],
    constants: dict[str, object],
    target: GPUTarget,
) -> None:
    """Bind arguments of the types of `signature` as a launch does, which compilation by itself leaves out.

    Triton binds them in a function that it generates, where an argument can have the name of a variable, such as
    `params`.
    """
    floats, zeros = torch.empty(4), {"i32": 0, "fp32": 0.0}
    arguments = {name: constants.get(name, zeros.get(type_, floats)) for name, type_ in signature.items()}
    bind = create_function_from_signature(function.signature, function.params, make_backend(target))
    bound = bind(**arguments)[0]
    if any(bound[name] is not value for name, value in arguments.items()):
        raise TypeError(f"{function.__name__}: Triton binds {bound} where {arguments} were given.")


def resources(binary: bytes) -> tuple[int, int]:
    """Return the registers and the bytes of stack per thread that cuobjdump reads from a binary."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(binary)
        file.flush()
        tool = triton.knobs.nvidia.cuobjdump.path
        told = subprocess.run(
            [tool, "-res-usage", file.name], capture_output=True, text=True, check=True
        ).stdout
    match = re.search(r"REG:(\d+) STACK:(\d+)", told)
    if match is None:
        raise RuntimeError(f"The output of cuobjdump -res-usage names no registers: {told!r}")
    return int(match[1]), int(match[2])


def settings(variant: Variant) -> tuple[triton.Config, ...]:
    """Return the launch settings of a variant, the one used where nothing was measured first."""
    return variant.settings or tuple(variant.kernel.configs)


def main(arguments: list[str]) -> None:
    if os.environ.get("TRITON_INTERPRET") == "1":
        raise SystemExit("TRITON_INTERPRET=1 puts the interpreter in the place of the compiler; unset it.")
    first = "--first" in arguments
    for architecture in [int(x) for x in arguments if x.isdigit()] or [80, 90]:
        for variant in variants():
            for setting in settings(variant)[: 1 if first else None]:
                print(json.dumps(asdict(compile_variant(variant, setting, architecture))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
