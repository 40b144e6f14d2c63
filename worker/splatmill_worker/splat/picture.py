"""Rendered colours as 8-bit pictures and JPEG."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from PIL import Image
from torch import Tensor

from splatmill.files import replacing


def as_image(color: Tensor) -> Image.Image:
    """An 8-bit picture of colour [H, W, 3]: floats in 0 to 1 are scaled, uint8 values taken as they are."""
    if color.is_floating_point():
        color = (color.detach().clamp(0.0, 1.0) * 255.0).round().byte()
    return Image.fromarray(color.cpu().contiguous().numpy())


def save_jpeg(path: Path, color: Tensor) -> None:
    """Write colour [H, W, 3] in 0..1 as JPEG; the file is replaced atomically."""
    with replacing(path) as part:
        as_image(color).save(part, "JPEG", quality=88)


def data_uri(color: Tensor, longest: int) -> str:
    """A data: URI of a JPEG of colour [H, W, 3], reduced to `longest` pixels on the longer side at most."""
    image = as_image(color)
    image.thumbnail((longest, longest))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=85)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()
