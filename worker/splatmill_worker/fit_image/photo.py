"""Reads the picture that is to be fitted, and refuses what cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatmill.schema.files.photos import MIN_PHOTO_SIDE
from splatmill_worker.errors import Refusal, UnusablePicture
from splatmill_worker.fit_image.plane import camera_before
from splatmill_worker.images import guarded
from splatmill_worker.images.decode import upright_size
from splatmill_worker.images.load import load_view
from splatmill_worker.scene import Normalization, View
from splatmill_worker.splat.views import TrainingView

Say = Callable[[str], None]
"""Gets each line for the user."""


ADVICE = {
    "not_an_image": "Give a JPEG, PNG, WebP, TIFF, HEIC or AVIF file.",
    "file_empty": "Give a JPEG, PNG, WebP, TIFF, HEIC or AVIF file.",
    "image_truncated": "Save the picture again from the program it came from.",
    "image_too_large": "Scale the picture down first.",
}


def load(path: Path, image_size: int, say: Say = lambda _: None) -> TrainingView:
    """The picture, upright, in 8 bits, with `image_size` pixels on the longer side at most.

    Raises Refusal for a file that is not a picture, does not decode, is too small or too large, or shows nothing.
    """
    try:
        width, height = _size(path, say)
        if max(width, height) > image_size:
            say(f"The picture is {width} x {height} pixels; it is scaled down to {image_size}.")
        photo = load_view(View(path.name, camera_before(width, height), path), image_size)
    except UnusablePicture as error:
        raise Refusal(error.code, f"{path}: {error.reason}.", advice=ADVICE[error.code]) from error
    except OSError as error:
        raise Refusal(
            "not_an_image", f"{path} cannot be read: {error.strerror}.", advice="Give one picture file."
        ) from error
    if photo.alpha is not None and not photo.alpha.any():
        raise Refusal(
            "not_an_image",
            f"{path} is transparent everywhere.",
            advice="Give a picture with pixels that are not transparent.",
        )
    return TrainingView.of(photo, Normalization(1.0, np.zeros(3)))


def _size(path: Path, say: Say) -> tuple[int, int]:
    """Upright width and height from the header. Raises Refusal for a size that cannot be fitted."""
    with guarded.opened(path) as image:
        width, height = upright_size(image)
        several = guarded.several(image)
    if min(width, height) < MIN_PHOTO_SIDE:
        raise Refusal(
            "image_too_small",
            f"{path} is {width} x {height} pixels; sides of {MIN_PHOTO_SIDE} pixels at least are needed.",
            advice="Give a larger picture, or enlarge this one.",
        )
    if several:
        say(f"{path.name} holds several pictures; the first one is fitted.")
    return width, height
