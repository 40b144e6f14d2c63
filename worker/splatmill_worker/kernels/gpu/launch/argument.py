"""Types of kernel arguments, as annotations: what a launch passes, and what `compiled` compiles a kernel for.

Triton takes the types of a launch from the arguments themselves; a test compares these with the annotations.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any, TypeAlias

import triton.language as tl

if TYPE_CHECKING:  # Triton's types are values, and a type checker takes no value for a type
    Float: TypeAlias = Any
    Int: TypeAlias = Any
    Floats: TypeAlias = Any
    Bytes: TypeAlias = Any
    Shorts: TypeAlias = Any
    Ints: TypeAlias = Any
    Longs: TypeAlias = Any
else:
    Float, Int = tl.float32, tl.int32
    Floats = tl.pointer_type(tl.float32)
    Bytes = tl.pointer_type(tl.uint8)
    Shorts, Ints, Longs = tl.pointer_type(tl.int16), tl.pointer_type(tl.int32), tl.pointer_type(tl.int64)


def declared(kernel: Any, name: str) -> str:
    """Return the declared type of one argument of a kernel as Triton writes it in signatures: `fp32`, `*i64`.

    Raises KeyError for an argument that is annotated with none of the types above.
    """
    function = kernel.fn
    kind = function.__globals__[inspect.signature(function).parameters[name].annotation]
    star, element = ("*", kind.element_ty) if kind.is_ptr() else ("", kind)
    letter = "fp" if element.is_floating() else "i" if element.is_int_signed() else "u"
    return f"{star}{letter}{element.primitive_bitwidth}"
