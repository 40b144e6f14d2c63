"""Turns decoded frames of a video into pictures: sRGB by their tags, with square pixels, upright, not interlaced."""

from __future__ import annotations

import struct
import sys
from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.filter import Graph
from av.video.reformatter import ColorRange, Interpolation
from PIL import Image

from splatmill_worker.images.colors.colors import SRGB, srgb_pixels
from splatmill_worker.images.flow import Grey
from splatmill_worker.images.video.video_tags import Tags, tags_of

MAX_ASPECT = 4
"""Largest aspect ratio of a pixel, or of its inverse, that is followed. Those of broadcasts are at most 32:11 (H.264,
table E-1), and lenses for wide screens squeeze by 2."""

EXACT = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""How swscale makes RGB: its default is a level too dark."""

TURNS: dict[tuple[float, ...], Image.Transpose | None] = {
    (1, 0, 0, 1): None,
    (0, 1, -1, 0): Image.Transpose.ROTATE_270,
    (-1, 0, 0, -1): Image.Transpose.ROTATE_180,
    (0, -1, 1, 0): Image.Transpose.ROTATE_90,
    (-1, 0, 0, 1): Image.Transpose.FLIP_LEFT_RIGHT,
    (1, 0, 0, -1): Image.Transpose.FLIP_TOP_BOTTOM,
    (0, 1, 1, 0): Image.Transpose.TRANSPOSE,
    (0, -1, -1, 0): Image.Transpose.TRANSVERSE,
}
"""What makes a frame upright, by the signs of its display matrix: a, b, c, d of (x, y) -> (a x + c y, b x + d y)."""

SPHERICAL = {0: "equirectangular", 1: "cubemap", 2: "equirectangular_tile", 3: "half_equirectangular"}
"""FFmpeg's projections of panoramas (AVSphericalProjection), and names for them."""

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" GPano:ProjectionType="{}"/>'
    "</rdf:RDF></x:xmpmeta>"
)
"""By which a frame is a panorama for those that read it as a photo (`images.panoramas.panoramas`)."""

Pixels = npt.NDArray[np.uint8]


def remarks(frame: av.VideoFrame, aspect: Fraction | None) -> list[str]:
    """What is assumed or converted in a video whose first frame is given, as sentences with {} for its name."""
    tags = tags_of(frame)
    said = [*tags.remarks]
    if tags.colors.hdr:
        said.append(f"{{}} is HDR ({tags.colors}); its frames were converted to SDR.")
    elif tags.colors != SRGB:
        said.append(f"{{}} has the colours of {tags.colors}; its frames were converted to sRGB.")
    if aspect is not None and not followed(aspect):
        said.append(
            f"The pixels of {{}} are said to be {aspect}, which no camera has; they are taken to be square."
        )
    elif shown_size(frame, aspect) != (frame.width, frame.height):
        said.append(f"The pixels of {{}} are not square ({aspect}); its frames were stretched.")
    if frame.interlaced_frame:
        said.append("{} is interlaced; of each frame, every second line was used.")
    if _signs(frame) not in TURNS:
        said.append("{} asks for its frames to be turned by a part of a quarter; they are left as they are.")
    return said


def followed(aspect: Fraction) -> bool:
    """Whether an aspect ratio of pixels is one that cameras have."""
    return Fraction(1, MAX_ASPECT) <= aspect <= MAX_ASPECT


def shown_size(frame: av.VideoFrame, aspect: Fraction | None) -> tuple[int, int]:
    """Width and height of a frame with square pixels, before it is turned. No side is less than the frame's."""
    if aspect is None or not followed(aspect):
        return frame.width, frame.height
    return round(frame.width * max(aspect, Fraction(1))), round(frame.height / min(aspect, Fraction(1)))


def grey(frame: av.VideoFrame, aspect: Fraction | None, side: int) -> Grey:
    """The frame in grey [H,W], with square pixels, reduced to a longest side of `side` pixels."""
    shown = shown_size(frame, aspect)
    factor = min(1.0, side / max(shown))
    width, height = (max(3, int(length * factor)) for length in shown)
    small = _reformatted(frame, tags_of(frame), "gray", Interpolation.AREA, width, height)
    values: npt.NDArray[np.float32] = small.to_ndarray().astype(np.float32)
    return values


def picture(frame: av.VideoFrame, aspect: Fraction | None) -> Image.Image:
    """A frame as an sRGB picture, upright."""
    image = Image.fromarray(_srgb(_field(frame) if frame.interlaced_frame else frame))
    size = shown_size(frame, aspect)
    if image.size != size:
        image = image.resize(size, Image.Resampling.LANCZOS)
    turn = TURNS.get(_signs(frame))
    return image if turn is None else image.transpose(turn)


def panorama_xmp(frame: av.VideoFrame) -> bytes:
    """The XMP of a frame that is a panorama by the spherical metadata of its video; empty for any other."""
    mapping: Any = frame.side_data.get("SPHERICAL")
    projection = None if mapping is None else SPHERICAL.get(int.from_bytes(bytes(mapping)[:4], sys.byteorder))
    return b"" if projection is None else XMP.format(projection).encode()


def _signs(frame: av.VideoFrame) -> tuple[float, ...]:
    """The entries a, b, c, d of a frame's display matrix over the largest of them, rounded to tenths."""
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return (1, 0, 0, 1)
    a, b, _, c, d, *_ = struct.unpack("=9i", bytes(matrix))
    largest = max(map(abs, (a, b, c, d))) or 1
    return tuple(round(entry / largest, 1) for entry in (a, b, c, d))


def _srgb(frame: av.VideoFrame) -> Pixels:
    """The pixels [H,W,3] of a frame as they are stored, in sRGB."""
    tags = tags_of(frame)
    plain = tags.colors == SRGB
    rgb = _reformatted(frame, tags, "rgb24" if plain else "rgb48le", EXACT)
    if plain:
        return np.asarray(rgb.to_ndarray(), np.uint8)
    # swscale fills 16 bits with a value of n bits by a shift; of limited range, the value has 8 bits and a fraction.
    bits = frame.format.components[0].bits if tags.range == ColorRange.JPEG else 8
    white = ((1 << bits) - 1 << 16 - bits) / 65535
    return srgb_pixels(np.asarray(rgb.to_ndarray(), np.uint16), tags.colors, white)


def _reformatted(
    frame: av.VideoFrame,
    tags: Tags,
    form: str,
    interpolation: Interpolation,
    width: int | None = None,
    height: int | None = None,
) -> av.VideoFrame:
    """The frame in the pixel format `form`, of full range; FFmpeg refuses matrices that it does not know."""
    return frame.reformat(
        width,
        height,
        form,
        src_colorspace=tags.matrix,
        dst_colorspace=tags.matrix,
        interpolation=interpolation,
        src_color_range=tags.range,
        dst_color_range=ColorRange.JPEG,
    )


def _field(frame: av.VideoFrame) -> av.VideoFrame:
    """Every second line of an interlaced frame: those between are of another moment."""
    graph = Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1000)
    )
    node, sink = graph.add("field"), graph.add("buffersink")
    source.link_to(node)
    node.link_to(sink)
    graph.configure()
    frame.pts, frame.time_base = 0, Fraction(1, 1000)
    source.push(frame)
    source.push(None)
    result = sink.pull()
    assert isinstance(result, av.VideoFrame)
    return result
