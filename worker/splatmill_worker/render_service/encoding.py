"""Renders a model and encodes the result: PNG, JPEG, WebP, 16-bit depth, or arrays of float32."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from splatmill.schema import DEPTH_SCALE_HEADER, CameraSpec, Format, Output, RenderRequest
from splatmill_worker.scene import Camera

if TYPE_CHECKING:
    from splatmill_worker.render_service.model_cache import LoadedModel

_BLACK, _WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_MAX_UINT16 = 65535


@dataclass(frozen=True)
class EncodedImage:
    """An image as the body of a response: its bytes, their media type, and further headers."""

    data: bytes
    media_type: str
    headers: Mapping[str, str] = field(default_factory=dict)


def camera_of(spec: CameraSpec) -> Camera:
    """Return the engine's camera for a camera of the wire schema."""
    fx, fy, cx, cy = spec.pinhole()
    return Camera(spec.width, spec.height, fx, fy, cx, cy, np.array(spec.viewmat(), dtype=np.float64))


def render_image(model: LoadedModel, request: RenderRequest) -> EncodedImage:
    """Render and encode the requested image."""
    camera = camera_of(request.camera)
    if request.output in (Output.median_depth, Output.normal):
        depth, normal = _surface(model, camera)
        if request.output is Output.median_depth:
            return _encode_depth(depth, request)
        return _encode_normal(normal, request)
    arrays = _render(model, camera, request.background)
    match request.output:
        case Output.color:
            return _encode_color(arrays, request)
        case Output.alpha:
            return _encode_alpha(arrays["alpha"], request)
        case Output.depth:
            return _encode_depth(arrays["depth"], request)


def render_frame(model: LoadedModel, camera: Camera, background: str) -> npt.NDArray[np.uint8]:
    """Return a frame of a video: 8-bit RGB [H, W, 3]."""
    return _to_uint8(_render(model, camera, background)["color"])


def _render(model: LoadedModel, camera: Camera, background: str) -> dict[str, npt.NDArray[np.float32]]:
    """Return color [H, W, 3], alpha [H, W] and mean depth [H, W] as float32 arrays."""
    import torch  # loaded with the first image, so that an idle renderer is small

    from splatmill_worker.splat.render import render

    with torch.no_grad():
        rendered = render(
            model.seen_by(camera),
            camera,
            background=_WHITE if background == "white" else _BLACK,
            antialias=model.antialias,
            backend=cast(Any, model.backend),
        )
        depth = rendered.expected_depth()
    arrays = {"color": rendered.color, "alpha": rendered.alpha, "depth": depth}
    return {name: tensor.cpu().numpy() for name, tensor in arrays.items()}


def _surface(model: LoadedModel, camera: Camera) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return median depth [H, W] and normals [H, W, 3] as float32 arrays."""
    from splatmill_worker.splat.surface import surface

    view = surface(model.seen_by(camera), camera, antialias=model.antialias, backend=cast(Any, model.backend))
    return view.depth.cpu().numpy(), view.normal.cpu().numpy()


def _encode_color(arrays: dict[str, Any], request: RenderRequest) -> EncodedImage:
    color = arrays["color"]
    if request.background == "transparent":
        # Rendered over black, the colour is premultiplied by alpha. Image formats store it unmultiplied.
        alpha = np.clip(arrays["alpha"], 0.0, 1.0)[..., None]
        color = np.concatenate([color / np.maximum(alpha, 1e-6), alpha], axis=-1)
    if request.format is Format.npy:
        return _encode_array(color)
    return _encode_pixels(_to_uint8(color), request)


def _encode_alpha(alpha: npt.NDArray[np.float32], request: RenderRequest) -> EncodedImage:
    return _encode_array(alpha) if request.format is Format.npy else _encode_pixels(_to_uint8(alpha), request)


def _encode_depth(depth: npt.NDArray[np.float32], request: RenderRequest) -> EncodedImage:
    if request.format is Format.npy:
        return _encode_array(depth)
    scale = max(float(depth.max(initial=0.0)), 1e-12) / _MAX_UINT16
    # 0 means that nothing was hit, so that a small depth must not be rounded to it.
    pixels = np.where(depth > 0, np.clip(np.rint(depth / scale), 1, _MAX_UINT16), 0).astype(np.uint16)
    encoded = _encode_pixels(pixels, request)
    return EncodedImage(encoded.data, encoded.media_type, {DEPTH_SCALE_HEADER: repr(scale)})


def _encode_normal(normal: npt.NDArray[np.float32], request: RenderRequest) -> EncodedImage:
    if request.format is Format.npy:
        return _encode_array(normal)
    there = np.any(normal != 0, axis=-1, keepdims=True)
    return _encode_pixels(_to_uint8(np.where(there, 0.5 + 0.5 * normal, 0.0)), request)


def _to_uint8(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    return (np.clip(values, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _encode_array(values: npt.NDArray[np.float32]) -> EncodedImage:
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(values, dtype=np.float32))
    return EncodedImage(stream.getvalue(), Format.npy.media_type)


def _encode_pixels(pixels: npt.NDArray[Any], request: RenderRequest) -> EncodedImage:
    from PIL import Image

    image, stream = Image.fromarray(pixels), io.BytesIO()
    match request.format:
        case Format.png:
            # Level 1 takes a third of the time of the default level, for a tenth more bytes.
            image.save(stream, "PNG", compress_level=1)
        case Format.jpeg:
            image.save(stream, "JPEG", quality=request.quality)
        case Format.webp:
            image.save(stream, "WEBP", quality=request.quality, method=2)
        case Format.npy:
            raise AssertionError("arrays are not encoded as images")
    return EncodedImage(stream.getvalue(), request.format.media_type)
