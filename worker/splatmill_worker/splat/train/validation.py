"""Which training photos are set aside for the decisions that a training makes while it runs."""

from __future__ import annotations


def validation_indices(photos: int, count: int) -> tuple[int, ...]:
    """Indices of `count` of `photos` photos in order of name: the middle ones of as many equal parts.

    They lie all over the capture, and depend on these two numbers alone, so that a resumed run sets aside the same.
    Raises ValueError where no photo would be left to train on.
    """
    if count and count >= photos:
        raise ValueError(
            f"{count} of {photos} photos are to be set aside, which leaves none to train on; set aside fewer."
        )
    return tuple((2 * part + 1) * photos // (2 * count) for part in range(count))
