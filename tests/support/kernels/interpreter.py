"""Triton's interpreter, in which the GPU kernels are tested on machines without a GPU."""

from __future__ import annotations

import os
from types import FunctionType
from typing import Any

import torch


def ask_for_it() -> None:
    """Run Triton's kernels in its interpreter where there is no GPU. To be called before Triton is first imported."""
    if not torch.cuda.is_available():
        os.environ.setdefault("TRITON_INTERPRET", "1")
    if os.environ.get("TRITON_INTERPRET") == "1":
        _patch_once()


def _patch_once() -> None:
    """Keep the interpreter from searching `triton.language` at every call of a device function.

    For the length of a call it puts its own operations in the place of the language's. Within a kernel they are in
    place already, and searching for what is left to replace takes more than half of the time of these tests. Where
    Triton has no such function (its name is private), everything runs as before, only slower.
    """
    try:
        import triton.language as tl
        from triton.runtime import interpreter

        replace = interpreter._patch_lang
        none = interpreter._LangPatchScope
    except (ImportError, AttributeError):
        return
    languages: dict[FunctionType, list[Any]] = {}

    def once(function: FunctionType) -> object:
        if function not in languages:
            seen = function.__globals__.values()
            languages[function] = [value for value in seen if value is tl or value is tl.core]
        fresh = any(tl.core.is_builtin(language.load) for language in languages[function])
        return replace(function) if fresh else none()

    interpreter._patch_lang = once
