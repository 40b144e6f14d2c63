"""Reads the picture that is to be fitted, and refuses what cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from splatmill.schema.photos import MAX_PHOTO_PIXELS, MIN_PHOTO_SIDE
from splatmill_worker.errors import Refusal
from splatmill_worker.fit_image.plane import camera_before
from splatmill_worker.images import load_view
from splatmill_worker.images.decode import upright_size
from splatmill_worker.scene import Normalization, View
from splatmill_worker.splat.views import TrainingView

Say = Callable[[str], None]
"""Gets each line for the user."""


def load(path: Path, image_size: int, say: Say = lambda _: None) -> TrainingView:
    """The picture, upright, in 8 bits, with `image_size` pixels on the longer side at most.

    Raises Refusal for a file that is not a picture, does not decode, is too small or too large, or shows nothing.
    """
    try:
        width, height = _size(path, say)
        if max(width, height) > image_size:
            say(f"The picture is {width} x {height} pixels; it is scaled down to {image_size}.")
        photo = load_view(View(path.name, camera_before(width, height), path), image_size)
    except UnidentifiedImageError as error:
        raise Refusal(
            "not_an_image",
            f"{path} is not a picture that can be read.",
            advice="Give a JPEG, PNG, WebP, TIFF or HEIC file.",
        ) from error
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        raise Refusal(
            "not_an_image", f"{path} cannot be read: {error.strerror}.", advice="Give one picture file."
        ) from error
    except (OSError, ValueError, SyntaxError, EOFError, IndexError) as error:
        raise Refusal(
            "image_truncated",
            f"{path} does not decode to its end: {error}.",
            advice="Save the picture again from the program it came from.",
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
    with Image.open(path) as image:
        width, height = upright_size(image)
        pictures = getattr(image, "n_frames", 1)
    if min(width, height) < MIN_PHOTO_SIDE:
        raise Refusal(
            "image_too_small",
            f"{path} is {width} x {height} pixels; sides of {MIN_PHOTO_SIDE} pixels at least are needed.",
            advice="Give a larger picture, or enlarge this one.",
        )
    if width * height > MAX_PHOTO_PIXELS:
        raise Refusal(
            "image_too_large",
            f"{path} is {width} x {height} pixels; at most {MAX_PHOTO_PIXELS // 10**6} million are decoded.",
            advice="Scale the picture down first.",
        )
    if pictures > 1:
        say(f"{path.name} holds {pictures} pictures; the first one is fitted.")
    return width, height
