"""A rendering as the bytes of a picture: PNG, JPEG, WebP, 16-bit depth or float32 arrays."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from splatmill.schema import DEPTH_SCALE_HEADER, CameraSpec, Format, Output, RenderRequest

if TYPE_CHECKING:
    from splatmill_worker.render_service.model_cache import StoredModel
    from splatmill_worker.scene import Camera

_BLACK, _WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_DEEPEST = 65535


@dataclass(frozen=True)
class Picture:
    """Encoded bytes with their media type and further response headers."""

    data: bytes
    media_type: str
    headers: Mapping[str, str] = field(default_factory=dict)


def camera_of(spec: CameraSpec) -> Camera:
    """The engine's camera for one of the wire."""
    from splatmill_worker.scene import Camera

    fx, fy, cx, cy = spec.pinhole()
    return Camera(spec.width, spec.height, fx, fy, cx, cy, np.array(spec.viewmat(), dtype=np.float64))


def take(model: StoredModel, wish: RenderRequest) -> Picture:
    """Render what is wished and encode it."""
    arrays = _rendered(model, camera_of(wish.camera), wish.background)
    match wish.output:
        case Output.color:
            return _color(arrays, wish)
        case Output.alpha:
            return _alpha(arrays["alpha"], wish)
        case Output.depth:
            return _depth(arrays["depth"], wish)


def frame(model: StoredModel, camera: Camera, background: str) -> npt.NDArray[np.uint8]:
    """A view as 8-bit RGB [H, W, 3], for a video."""
    return _bytes(_rendered(model, camera, background)["color"])


def _rendered(model: StoredModel, camera: Camera, background: str) -> dict[str, npt.NDArray[np.float32]]:
    """color [H, W, 3], alpha [H, W] and mean depth [H, W] as float32 arrays."""
    import torch

    from splatmill_worker.splat.render import render

    with torch.no_grad():
        seen = render(
            model.gaussians,
            camera,
            background=_WHITE if background == "white" else _BLACK,
            antialias=model.antialias,
            backend=cast(Any, model.backend),
        )
        depth = seen.expected_depth()
    arrays = {"color": seen.color, "alpha": seen.alpha, "depth": depth}
    return {name: tensor.cpu().numpy() for name, tensor in arrays.items()}


def _color(arrays: dict[str, Any], wish: RenderRequest) -> Picture:
    color = arrays["color"]
    if wish.background == "transparent":
        # Over black the colour is already weighted by alpha; picture formats want it unweighted.
        alpha = np.clip(arrays["alpha"], 0.0, 1.0)[..., None]
        color = np.concatenate([color / np.maximum(alpha, 1e-6), alpha], axis=-1)
    if wish.format is Format.npy:
        return _array(color)
    return _encoded(_bytes(color), wish)


def _alpha(alpha: npt.NDArray[np.float32], wish: RenderRequest) -> Picture:
    return _array(alpha) if wish.format is Format.npy else _encoded(_bytes(alpha), wish)


def _depth(depth: npt.NDArray[np.float32], wish: RenderRequest) -> Picture:
    if wish.format is Format.npy:
        return _array(depth)
    scale = max(float(depth.max(initial=0.0)), 1e-12) / _DEEPEST
    # Rounding must not turn the nearest hit into 0, which says that nothing was hit.
    whole = np.where(depth > 0, np.clip(np.rint(depth / scale), 1, _DEEPEST), 0).astype(np.uint16)
    encoded = _encoded(whole, wish)
    return Picture(encoded.data, encoded.media_type, {DEPTH_SCALE_HEADER: repr(scale)})


def _bytes(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _array(values: npt.NDArray[np.float32]) -> Picture:
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(values, dtype=np.float32))
    return Picture(stream.getvalue(), Format.npy.media_type)


def _encoded(pixels: npt.NDArray[Any], wish: RenderRequest) -> Picture:
    from PIL import Image

    image, stream = Image.fromarray(pixels), io.BytesIO()
    match wish.format:
        case Format.png:
            # Level 1 is three times as fast as the default for a tenth more bytes.
            image.save(stream, "PNG", compress_level=1)
        case Format.jpeg:
            image.save(stream, "JPEG", quality=wish.quality)
        case Format.webp:
            image.save(stream, "WEBP", quality=wish.quality, method=2)
        case Format.npy:
            raise AssertionError("arrays are not pictures")
    return Picture(stream.getvalue(), wish.format.media_type)
