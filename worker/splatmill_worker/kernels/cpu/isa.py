"""Which build of the engine runs here: the best one that the processor supports, or the one that was asked for."""

import importlib
import os
from types import ModuleType

ISAS = ("avx512", "avx2", "baseline")
VARIABLE = "SPLATMILL_CPU_ISA"


def supported() -> tuple[str, ...]:
    """Instruction sets of this processor that the engine has a build for, best first."""
    return tuple(importlib.import_module(f"{__package__}._cpu_baseline").supported())


def load(isa: str) -> ModuleType:
    """The engine's extension module for `isa`; raises RuntimeError when the processor cannot run it."""
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
    """`SPLATMILL_CPU_ISA` where it is set, else the best build that this processor supports."""
    return os.environ.get(VARIABLE) or supported()[0]
