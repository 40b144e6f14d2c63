"""Compiling the variants into a build folder of the benchmark, and running the engine on one of them."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType
from unittest import mock

from _rows import HERE, running
from torch import Tensor

from _studies.precision import formats
from _studies.precision.variants import BY_NAME, FLOAT32, Variant
from splatmill_worker.kernels.cpu import blocks, isa
from splatmill_worker.kernels.cpu.step import Step

SOURCE = HERE.parent
ISA = isa.chosen()
FIRST_SH = blocks.FIRST["sh"]


def compiled(variants: Iterable[Variant], folder: Path) -> dict[str, ModuleType]:
    """Compile the variants for the instruction set in use, and return their modules by name."""
    variants = list(variants)
    folder.mkdir(parents=True, exist_ok=True)
    listed = folder / "variants.cmake"
    text = "".join(
        f"variant({v.name} [==[{';'.join(v.definitions)}]==] {' '.join(v.sources)})\n"
        for v in BY_NAME.values()
    )
    if not listed.exists() or listed.read_text() != text:
        listed.write_text(text)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    options = {"CMAKE_BUILD_TYPE": "Release", "Python_EXECUTABLE": sys.executable, "SPLATMILL_VARIANTS": listed,
               "SPLATMILL_VARIANT_ISA": ISA}  # fmt: skip
    _run(
        ["cmake", "-G", "Ninja", "-S", SOURCE, "-B", folder / "cmake", *(f"-D{k}={v}" for k, v in options.items())],
        environment,
    )  # fmt: skip
    targets = [f"variant_{v.name}" for v in variants]
    _run(["cmake", "--build", folder / "cmake", "--parallel", "2", "--target", *targets], environment)
    return {v.name: _loaded(folder / "cmake" / "variants" / v.name) for v in variants}


def _run(command: list[str | Path], environment: dict[str, str]) -> None:
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{command[:3]} failed:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")


def _loaded(folder: Path) -> ModuleType:
    (path,) = folder.glob(f"_cpu_{ISA}.*")
    spec = importlib.util.spec_from_file_location(f"_cpu_{ISA}", path)
    assert spec is not None, path
    assert spec.loader is not None, path
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def using(variant: Variant, module: ModuleType) -> Iterator[None]:
    """Run every step in this block with a variant.

    What a `Step` holds in a narrower format lies at the front of the tensors that have room for float32, and is widened
    for whoever asks the step for it.
    """
    replace, parameters, moments = Step.replace, Step.parameters, Step.moments

    def narrow_replace(
        self: Step, params: dict[str, Tensor], exp_avg: Tensor | None, exp_avg_sq: Tensor | None
    ) -> None:
        replace(self, params, exp_avg, exp_avg_sq)
        for name, narrow in _held(variant).items():
            setattr(self, name, narrow.stored(getattr(self, name)))

    @contextmanager
    def wide(self: Step) -> Iterator[None]:
        kept = {name: getattr(self, name) for name in _held(variant)}
        for name, narrow in _held(variant).items():
            setattr(self, name, narrow.restored(kept[name]))
        try:
            yield
        finally:
            for name, value in kept.items():
                setattr(self, name, value)

    def wide_parameters(self: Step) -> dict[str, Tensor]:
        with wide(self):
            return parameters(self)

    def wide_moments(self: Step) -> tuple[Tensor, Tensor]:
        with wide(self):
            return moments(self)

    patched = {"replace": narrow_replace, "parameters": wide_parameters, "moments": wide_moments}
    with ExitStack() as stack:
        stack.enter_context(running(module))
        if _held(variant):
            for name, method in patched.items():
                stack.enter_context(mock.patch.object(Step, name, method))
        yield


def _held(variant: Variant) -> dict[str, formats.Narrow]:
    """The tensors of a Step that a variant holds in narrower formats."""
    found = {
        "blocks": formats.Narrow(variant.harmonics, FIRST_SH),
        "exp_avg": formats.Narrow(variant.first, 0),
        "exp_avg_sq": formats.Narrow(variant.second, 0),
    }
    return {name: narrow for name, narrow in found.items() if narrow.format != FLOAT32}
