"""Constants that kernels read from their module."""

from __future__ import annotations

from typing import Any

import triton.language as tl

from ..device import interpreting


def constant(value: float) -> Any:
    """Return `value` as the compile-time constant that a kernel may read from its module.

    Under the interpreter the result is the bare number, because an operator with a constexpr on its left and an array
    on its right gives a constexpr there, not an array.
    """
    return value if interpreting() else tl.constexpr(value)


LARGEST = constant(3.4028234e38)
"""The largest finite float32."""
