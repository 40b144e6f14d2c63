"""Values between an attempt and its decoding processes: a JSON text, and behind it the bytes of the arrays in it.

An answer may come from a process that a file has taken over. So nothing is unpickled, an array has one of few types,
and an error is one of few classes.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill_worker.errors import ModelUnreadable, StartUnusable, UnusablePicture, UnusableVideo

_ARRAY = ""
"""Key of a JSON object that stands for an array: its value is the type and the shape."""

_BYTES = "bytes"
"""Type of an array that is a Python `bytes`."""

_TYPE = re.compile(r"[<|][biuf][1248]")
"""Names that NumPy gives to its little-endian types of booleans, integers and floats."""

MAX_REASON = 1000
"""Characters of what a decoding process says of a file."""

Bytes = npt.NDArray[np.uint8]

_PICTURE_CODES = ("file_empty", "not_an_image", "image_truncated", "image_too_small", "image_too_large")


# No function below is nested and calls itself: such a one is a reference cycle, and would hold the arrays of photos in
# memory until the garbage collector runs.


def packed(value: Any) -> tuple[bytes, list[memoryview]]:
    """The JSON text of a value, and the bytes of its arrays.

    value: of dicts, lists, tuples, dataclasses, str, numbers, None, bytes and NumPy arrays. Dataclasses become dicts,
        and tuples become lists.
    """
    parts: list[memoryview] = []
    return json.dumps(_plain(value, parts)).encode(), parts


def _plain(item: Any, parts: list[memoryview]) -> Any:
    """`item` in JSON's types; the bytes of its arrays are appended to `parts`."""
    if isinstance(item, np.ndarray):
        array = np.ascontiguousarray(item, item.dtype.newbyteorder("<"))
        parts.append(array.reshape(-1).view(np.uint8).data)
        return {_ARRAY: [array.dtype.str, list(item.shape)]}
    if isinstance(item, bytes):
        parts.append(memoryview(item))
        return {_ARRAY: [_BYTES, [len(item)]]}
    if isinstance(item, np.generic):
        return item.item()
    if is_dataclass(item) and not isinstance(item, type):
        return _plain(asdict(item), parts)
    if isinstance(item, dict):
        return {str(key): _plain(inner, parts) for key, inner in item.items()}
    if isinstance(item, (list, tuple)):
        return [_plain(inner, parts) for inner in item]
    return item


def unpacked(text: bytes | bytearray, payload: Bytes) -> Any:
    """The value that `packed` was given; its arrays lie in `payload`. Raises ValueError for any other text."""
    rest = [payload]
    try:
        value = _whole(json.loads(text), rest)
    except (TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError("the answer is no value") from error
    if len(rest[0]):
        raise ValueError("the answer is longer than its arrays")
    return value


def _whole(item: Any, rest: list[Bytes]) -> Any:
    """The value that `_plain` was given; its arrays are taken from the beginning of `rest`, a list of one array."""
    if isinstance(item, list):
        return [_whole(inner, rest) for inner in item]
    if not isinstance(item, dict):
        return item
    if _ARRAY not in item:
        return {key: _whole(inner, rest) for key, inner in item.items()}
    name, shape = item[_ARRAY]
    if not all(type(side) is int and side >= 0 for side in shape):
        raise ValueError("the shape of an array is not valid")
    if name != _BYTES and not _TYPE.fullmatch(name):
        raise ValueError("the type of an array is not valid")
    kind = np.dtype(np.uint8 if name == _BYTES else name)
    size = math.prod(shape) * kind.itemsize
    if size > len(rest[0]):
        raise ValueError("an array is longer than what was sent")
    content, rest[0] = rest[0][:size], rest[0][size:]
    return content.tobytes() if name == _BYTES else content.view(kind).reshape(shape)


_CLASSES: dict[str, tuple[type[Exception], Callable[[Any], list[Any]]]] = {
    "picture": (UnusablePicture, lambda error: [error.code, error.facts["file"], error.reason]),
    "video": (UnusableVideo, lambda error: [error.facts["file"], error.reason]),
    "model": (ModelUnreadable, lambda error: [error.message]),
    "start": (StartUnusable, lambda error: [error.message]),
    "value": (ValueError, lambda error: [str(error)]),
}
"""The errors that are raised again as they were, by a name, with what their constructors take."""


def described(error: Exception) -> dict[str, Any]:
    """An error as a value. It is raised again if it is of one of _CLASSES, an OSError, or a MemoryError."""
    if isinstance(error, OSError) and error.errno is not None:
        return {"name": "system", "given": [error.errno, str(error.strerror), str(error.filename)]}
    if isinstance(error, MemoryError):
        return {"name": "memory", "given": []}
    for name, (kind, arguments_of) in _CLASSES.items():
        if type(error) is kind:
            return {"name": name, "given": [str(value)[:MAX_REASON] for value in arguments_of(error)]}
    return {"name": "other", "given": [f"{type(error).__name__}: {error}"[:MAX_REASON]]}


def error_of(description: Any, fault: Callable[[str], Exception]) -> Exception:
    """The error of a description; `fault` makes one of a reason where its class is not known.

    Raises ValueError for anything but a description.
    """
    try:
        name, arguments = description["name"], description["given"]
        if name == "system":
            number, text, path = arguments
            return OSError(int(number), str(text)[:MAX_REASON], str(path)[:MAX_REASON])
        if name == "memory":
            return MemoryError()
        arguments = [str(value)[:MAX_REASON] for value in arguments]
        if name == "picture" and arguments[0] not in _PICTURE_CODES:
            raise ValueError("the code of a fault is not known")
        if name in _CLASSES:
            return _CLASSES[name][0](*arguments)
        return fault(f"it does not decode: {arguments[0]}")
    except (TypeError, KeyError, IndexError, OverflowError) as error:
        raise ValueError("the description of an error is not valid") from error
