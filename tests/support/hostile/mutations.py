"""Files as a stranger may change them: pieces of a valid file replaced by extreme numbers, other bytes, or copies."""

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
    """One to four changes of a valid binary file: bytes are overwritten, inserted, repeated or removed."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        piece = data[start : start + draw(st.integers(1, 64) | st.just(len(data)))]
        copies = st.integers(0, 20 if len(piece) <= 64 else 1).map(piece.__mul__)
        new = draw(st.sampled_from(_EXTREMES) | st.binary(min_size=1, max_size=32) | copies)
        data = data[:start] + new + data[start + (len(new) if draw(st.booleans()) else len(piece)) :]
    return data


@st.composite
def text_mutations(draw: st.DrawFn, data: bytes) -> bytes:
    """One to three changes of a valid text file: numbers become other words, or bytes change."""
    for _ in range(draw(st.integers(1, 3))):
        numbers = [match.span() for match in _NUMBER.finditer(data)]
        whole: bool = draw(st.booleans())
        if numbers and whole:
            start, end = draw(st.sampled_from(numbers))
            data = data[:start] + draw(st.sampled_from(_WORDS)) + data[end:]
        else:
            data = draw(mutations(data))
    return data
