"""Reads the file of a given model into arrays, in a process of its own: see `images.decoding.decoders.call_once`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatmill_worker.splat.formats import registry


def read(
    path: Path, most: int
) -> dict[str, npt.NDArray[np.float32] | tuple[float, ...] | list[str] | int | None]:
    """The five parameters of the `most` most opaque Gaussians of a file, its `offset`, the `count` of all
    of them, whether it is drawn `antialiased` (None where the file does not say so), and `notes`, as in `Contents`.

    Raises ModelUnreadable and OSError.
    """
    contents = registry.read(path)
    gaussians = contents.gaussians
    return {
        **{name: value.numpy() for name, value in gaussians.most_opaque(most).parameters().items()},
        "offset": contents.offset,
        "count": gaussians.count,
        "antialiased": contents.antialiased,
        "notes": [*contents.notes],
    }
