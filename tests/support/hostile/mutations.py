"""Files as a stranger may change them: bytes of a valid file flipped, cut, repeated, or set to extreme numbers."""

from __future__ import annotations

import re
import struct

from hypothesis import strategies as st

_EXTREMES = tuple(
    struct.pack(form, value)
    for form, values in {
        "<H": (0, 0xFFFF, 0x8000),
        "<I": (0, 1, 0xFFFFFFFF, 0x7FFFFFFF, 0x80000000),
        "<Q": (0, 2**64 - 1, 2**63, 2**50, 2**32),
        "<f": (float("nan"), float("inf"), -float("inf"), 1e38, -0.0),
        "<d": (float("nan"), float("inf"), 1e300, -1e-300),
    }.items()
    for value in values
)
_WORDS = b'nan inf -inf 1e400 -1 0 4294967296 18446744073709551616 1e-320 [] {} null "\\u0000" ../../x'.split(
    b" "
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@st.composite
def mutations(draw: st.DrawFn, data: bytes) -> bytes:
    """One to four changes of a valid binary file."""
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(0, len(data) - 1)))
        match draw(st.sampled_from(("set", "flip", "cut", "repeat", "remove", "insert"))):
            case "set":
                value = draw(st.sampled_from(_EXTREMES))
                data = data[:place] + value + data[place + len(value) :]
            case "flip":
                data = (
                    data[:place] + bytes([data[place] ^ draw(st.integers(1, 255))]) + data[place + 1 :]
                    if data
                    else b""
                )
            case "cut":
                data = data[:place]
            case "repeat":
                end = place + draw(st.integers(1, 64))
                data = data[:end] + data[place:end] * draw(st.integers(1, 20)) + data[end:]
            case "remove":
                data = data[:place] + data[place + draw(st.integers(1, 64)) :]
            case "insert":
                data = data[:place] + draw(st.binary(min_size=1, max_size=32)) + data[place:]
    return data


@st.composite
def text_mutations(draw: st.DrawFn, data: bytes) -> bytes:
    """One to three changes of a valid text file: numbers become other words, or bytes change."""
    for _ in range(draw(st.integers(1, 3))):
        numbers = list(_NUMBER.finditer(data))
        whole: bool = draw(st.booleans())
        if numbers and whole:
            start, end = numbers[draw(st.integers(0, len(numbers) - 1))].span()
            data = data[:start] + draw(st.sampled_from(_WORDS)) + data[end:]
        else:
            data = draw(mutations(data))
    return data
