"""Memory that reading a file may take: what the file announces is compared with it before any is taken.

Files are small where they are written by strangers to fill a memory: a picture of one colour, a gzip of zeros.
"""

from __future__ import annotations

from splatmill.schema.quantities import format_bytes
from splatmill_worker import memory

COPIES = 7
"""Times the memory of the parameters that a reader of models takes at its peak, at most, unless it names another
number; a test measures each."""

FREE_BYTES = 128 * 2**20
"""Any file may take this much."""

MOST_TIMES = 400
"""Times its own size that a file may take beyond FREE_BYTES. Models reach 20 to 200; one deflated byte can stand for
1,032 others, and one of WebP for millions."""

_limit: int | None = None


def limit() -> int:
    """Bytes that reading a file may take: those that are free, or those of `set_limit`."""
    return memory.available() if _limit is None else _limit


def set_limit(size: int) -> None:
    """Set the limit, in a process that may not measure what is free."""
    global _limit
    _limit = size


def check(what: str, needed: int, size: int) -> None:
    """Raise ValueError, in which `what` is the subject, if a file of `size` bytes may not take `needed` bytes."""
    if needed > max(FREE_BYTES, MOST_TIMES * size):
        raise ValueError(
            f"{what} would take {format_bytes(needed)} of memory, more than {MOST_TIMES} times the {size} bytes of the "
            "file: it is damaged, or made to fill the memory"
        )
    if needed > limit():
        raise ValueError(
            f"{what} would take {format_bytes(needed)} of memory, and {format_bytes(limit())} are free; "
            "reduce the file, or use a machine with more memory"
        )


def check_gaussians(count: int, degree: int, size: int, copies: int = COPIES) -> None:
    """Raise ValueError if a file of `size` bytes may not hold so many Gaussians with harmonics of `degree`.

    copies: times the memory of the parameters that the reader takes.
    """
    check(f"reading its {count:,} Gaussians", copies * parameter_bytes(degree) * count, size)


def parameter_bytes(degree: int) -> int:
    """Bytes of the parameters of a Gaussian with harmonics of `degree`."""
    return 4 * (11 + 3 * (degree + 1) ** 2)
