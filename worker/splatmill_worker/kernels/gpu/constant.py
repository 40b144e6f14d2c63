"""Numbers that kernels read from their module."""

from __future__ import annotations

from typing import Any

import triton.language as tl

from .device import interpreting


def constant(value: float) -> Any:
    """`value` as the compile-time constant that a kernel may read from its module.

    Under the interpreter the bare number: there a constexpr to the left of an array swallows the array.
    """
    return value if interpreting() else tl.constexpr(value)
