"""The CPU engine: C++ kernels in one build per instruction set, chosen when this package is imported."""

import torch  # noqa: F401  # first, so that the engine shares torch's OpenMP runtime instead of loading another

from . import isa

ISA = isa.chosen()
engine = isa.load(ISA)

__all__ = ["ISA", "engine"]
