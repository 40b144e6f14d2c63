"""What Python and its libraries raise for damaged files, in words for the people whose files they are."""

from __future__ import annotations

import json
import re
import struct
import zipfile
import zlib

MAX_LENGTH = 1000
"""Characters of a message that are shown."""

JSON_FAULT = "line {} column {} is no JSON: a comma or a quote is missing or too many, or the file is cut off"

_RULES = (
    (re.compile(r"could not convert string to float: (.*)"), r"\1 stands where a number is needed"),
    (
        re.compile(r"invalid literal for int\(\) with base 10: (.*)"),
        r"\1 stands where a whole number is needed",
    ),
    (re.compile(r".*unpack_from requires a buffer.*|unpack requires a buffer.*"), "it ends too early"),
)
"""Messages of Python about values, and what they are replaced by."""


def plain(error: BaseException) -> str:
    """What is wrong with a file, as a part of a sentence without a full stop; no path of the machine is in it."""
    match error:
        case json.JSONDecodeError():
            return JSON_FAULT.format(error.lineno, error.colno)
        case UnicodeError():
            return "it is no text in UTF-8"
        case RecursionError():
            return "it nests too many objects or lists"
        case zipfile.BadZipFile() | zlib.error() | EOFError():
            return "its packed data are damaged or cut off"
        case NotImplementedError():
            return "it is encrypted, or packed by a method that is not known"
        case struct.error():
            return "it ends too early, or has a number out of range"
        case KeyError():
            return f"{str(error.args[0])[:80]!r} is missing"
        case FileNotFoundError():
            return "there is no such file"
        case OSError() | ValueError() if isinstance(said := getattr(error, "strerror", None), str):
            return said  # some errors of FFmpeg are ValueErrors
        case TypeError() | AttributeError() | IndexError():
            return "a value in it is of another kind than its format has"
    said = (str(error).strip().splitlines() or [type(error).__name__])[0]
    for pattern, replacement in _RULES:
        said = pattern.sub(replacement, said)
    return said[:MAX_LENGTH].rstrip(".")
