"""Triton's interpreter, in which the GPU kernels are tested on machines without a GPU."""

from __future__ import annotations

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
    for hasten in (_patch_once, _leave_out_idle_checks, _keep_dtypes):
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
            seen = function.__globals__.values()
            languages[function] = [value for value in seen if value is tl or value is tl.core]
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
