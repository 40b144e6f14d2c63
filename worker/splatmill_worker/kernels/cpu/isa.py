"""Choice of the CPU engine's build: the best that the processor supports, or the one asked for."""

import importlib
import os
from types import ModuleType

ISAS = ("avx512", "avx2", "baseline")
"""Instruction sets that the engine is built for, best first."""

VARIABLE = "SPLATMILL_CPU_ISA"
"""Environment variable that names the build to use."""


def supported() -> tuple[str, ...]:
    """Return the builds that this processor can run, best first."""
    return tuple(importlib.import_module(f"{__package__}._cpu_baseline").supported())


def load(isa: str) -> ModuleType:
    """Return the extension module built for `isa`. Raises RuntimeError where it does not exist or cannot run here."""
    if isa not in ISAS:
        raise RuntimeError(
            f"{VARIABLE}={isa!r} is not a build of the CPU engine; choose one of {', '.join(ISAS)}."
        )
    here = supported()
    if isa not in here:
        raise RuntimeError(
            f"{VARIABLE}={isa!r} was asked for, but this processor runs only {', '.join(here)}; "
            f"unset {VARIABLE} to let the engine choose."
        )
    return importlib.import_module(f"{__package__}._cpu_{isa}")


def chosen() -> str:
    """Return the value of SPLATMILL_CPU_ISA or, where it is not set, the best build that this processor can run."""
    return os.environ.get(VARIABLE) or supported()[0]
