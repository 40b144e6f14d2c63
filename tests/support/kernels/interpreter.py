"""Triton's interpreter, in which the GPU kernels are tested on machines without a GPU."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from types import FunctionType
from typing import Any

import torch


def ask_for_it() -> None:
    """Run Triton's kernels in its interpreter where there is no GPU. To be called before Triton is first imported.

    The interpreter is kept from work whose outcome it does not use. Its names for that are private: where Triton has
    others, everything runs as before, only slower.
    """
    if not torch.cuda.is_available():
        os.environ.setdefault("TRITON_INTERPRET", "1")
    if os.environ.get("TRITON_INTERPRET") != "1":
        return
    try:
        import triton.language as tl
        from triton.runtime import interpreter
    except ImportError:
        return
    for hasten in (
        _patch_once,
        _leave_out_idle_checks,
        _keep_dtypes,
        _keep_shapes,
        _compare_first,
        _call_directly,
    ):
        try:
            hasten(tl, interpreter)
        except (AttributeError, TypeError):
            continue


def _patch_once(tl: Any, interpreter: Any) -> None:
    """Keep the interpreter from searching `triton.language` at every call of a device function.

    For the length of a call it puts its own operations in the place of the language's. Within a kernel they are in
    place already, and searching for what is left to replace takes more than half of the time of these tests.
    """
    search = interpreter._patch_lang
    none = interpreter._LangPatchScope
    languages: dict[FunctionType, list[Any]] = {}

    def once(function: FunctionType) -> object:
        if function not in languages:
            values = function.__globals__.values()
            languages[function] = [value for value in values if value is tl or value is tl.core]
        fresh = any(tl.core.is_builtin(language.load) for language in languages[function])
        return search(function) if fresh else none()

    interpreter._patch_lang = once


def _leave_out_idle_checks(tl: Any, interpreter: Any) -> None:
    """Leave out the interpreter's check of integer sums and products for overflow, a third of the time of these tests.

    It computes each of them again in 64 bits and asserts that both agree. Outside Triton's debug mode, which the
    interpreter never has, the assertion is dropped after the computation. What overflows is still wrong here as it is
    on a GPU, and the proofs see it.
    """
    options = interpreter.interpreter_builder.options
    if not options.debug:
        interpreter.interpreter_builder.options = replace(options, sanitize_overflow=False)


def _keep_dtypes(tl: Any, interpreter: Any) -> None:
    """Keep NumPy's dtype of each type of Triton, which the interpreter looks up in a table that it makes anew."""
    look_up = interpreter._get_np_dtype
    known: dict[str, Any] = {}

    def kept(kind: Any) -> Any:
        element = kind.scalar
        if element.is_ptr():
            return look_up(element)
        if element.name not in known:
            known[element.name] = look_up(element)
        return known[element.name]

    interpreter._get_np_dtype = kept


def _keep_shapes(tl: Any, interpreter: Any) -> None:
    """Make the shape of a block, its number of elements and its type's name once for all of its tensors.

    Triton wraps each extent anew, with a type of its own, for every value that is computed.
    """
    core = tl.core
    blocks: dict[tuple[Any, ...], tuple[Any, int, str]] = {}
    extents: dict[tuple[int, ...], tuple[Any, Any]] = {}
    make_type = core.block_type.__init__

    def block_type(self: Any, element_ty: Any, shape: Any) -> None:
        plain = tuple(each.value if isinstance(each, core.constexpr) else each for each in shape)
        key = (element_ty.name, *plain)
        if key not in blocks:
            make_type(self, element_ty, shape)
            blocks[key] = self.shape, self.numel, self.name
        self.element_ty = element_ty
        self.shape, self.numel, self.name = blocks[key]

    def tensor(self: Any, handle: Any, type: Any) -> None:
        shape = tuple(type.shape.values) if type.is_block() else ()
        if shape not in extents:
            wrapped = core.tuple([core.constexpr(extent) for extent in shape])
            extents[shape] = wrapped, core.constexpr(math.prod(shape))
        self.handle, self.type, self.dtype = handle, type, type.scalar
        self.shape, self.numel = extents[shape]

    core.block_type.__init__ = block_type
    core.tensor.__init__ = tensor


def _compare_first(tl: Any, interpreter: Any) -> None:
    """See at once that a type is itself, and that two operands have one type and one shape: nothing is converted then.

    A product of half floats is computed in another type than theirs, so that they take the long way.
    """
    core, semantic = tl.core, type(interpreter.interpreter_semantic)
    same, check, broadcast = (
        core.dtype.__eq__, semantic.binary_op_type_checking_impl, semantic.broadcast_impl_value,
    )  # fmt: skip

    def equal(self: Any, other: Any) -> bool:
        return self is other or bool(same(self, other))

    def alike(left: Any, right: Any) -> bool:
        if not (isinstance(left, core.tensor) and isinstance(right, core.tensor)):
            return False
        blocks: bool = left.type.is_block() and right.type.is_block()
        return blocks and bool(left.shape.values == right.shape.values)

    def checked(self: Any, left: Any, right: Any, *more: Any, **others: Any) -> Any:
        if alike(left, right) and left.dtype is right.dtype and left.dtype.name in plain:
            return left, right
        return check(self, left, right, *more, **others)

    def broadcasted(self: Any, left: Any, right: Any) -> Any:
        return (left, right) if alike(left, right) else broadcast(self, left, right)

    plain = {kind.name for kind in (tl.float32, tl.float64, tl.int1, tl.int8, tl.int32, tl.int64)}
    core.dtype.__eq__ = equal
    semantic.binary_op_type_checking_impl = checked
    semantic.broadcast_impl_value = broadcasted


def _call_directly(tl: Any, interpreter: Any) -> None:
    """Give the language's functions their interpreter by one call, not by three that look for it and check it."""
    semantic = interpreter.interpreter_semantic

    def patch(obj: Any, name: str, member: Any, builder: Any, scope: Any) -> None:
        function = getattr(member, "__wrapped__", member)

        def call(*positional: Any, **named: Any) -> Any:
            named["_semantic"] = semantic
            return function(*positional, **named)

        scope.set_attr(obj, name, call)

    interpreter._patch_attr = patch
