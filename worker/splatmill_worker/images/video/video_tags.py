"""What the colour tags of a video say of its frames, and what is assumed where they say nothing."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import av
from av.video.reformatter import ColorRange, Colorspace

from splatmill_worker.images.colors.colors import PRIMARIES, TRANSFERS, Colors

MATRICES = {
    1: Colorspace.ITU709,
    4: Colorspace.FCC,
    5: Colorspace.ITU601,
    6: Colorspace.ITU601,
    7: Colorspace.SMPTE240M,
    9: Colorspace.BT2020,
}
"""The matrices of H.273 that swscale has, by their codes."""

MATRIX_NAMES = {Colorspace.ITU709: "BT.709", Colorspace.ITU601: "BT.601", Colorspace.BT2020: "BT.2020"}
"""Names of the matrices that are assumed where a video names none."""

HD_WIDTH, SD_HEIGHT = 1280, 576
"""Size in pixels from which on, and above which, players take a video without tags as BT.709, and else as BT.601."""

UNNAMED = (0, 2, 3)
"""The codes of H.273 of what is not named: unspecified (2), and reserved ones. For a matrix, 0 is that of RGB."""


@dataclass(frozen=True)
class Tags:
    """How the values of a frame are meant.

    colors: their primaries and transfer function.
    matrix: from YUV.
    range: of the values.
    remarks: what was assumed, as sentences about the video `{}`.
    """

    colors: Colors
    matrix: Colorspace
    range: ColorRange
    remarks: tuple[str, ...]


def tags_of(frame: av.VideoFrame) -> Tags:
    """The tags of a frame, with what players assume in place of those that are missing or make no sense."""
    rgb = frame.format.is_rgb
    codes = {"primaries": frame.color_primaries, "transfer function": frame.color_trc}
    codes |= {} if rgb else {"matrix": frame.colorspace}
    primaries, transfer = PRIMARIES.get(frame.color_primaries), TRANSFERS.get(frame.color_trc, "sRGB")
    wide = transfer in ("HLG", "PQ") or primaries == "BT.2020"
    high = frame.width >= HD_WIDTH or frame.height > SD_HEIGHT
    usual = Colorspace.BT2020 if wide else Colorspace.ITU709 if high else Colorspace.ITU601
    matrix = MATRICES.get(frame.colorspace, usual)
    wide |= matrix == Colorspace.BT2020 and not rgb
    colors = Colors(primaries or ("BT.2020" if wide else "sRGB"), transfer)
    missing = [name for name, code in codes.items() if code in UNNAMED]
    supported: tuple[Container[int], ...] = (PRIMARIES, TRANSFERS, MATRICES)
    unknown = [
        f"{name} {code}"
        for (name, code), known in zip(codes.items(), supported, strict=False)
        if code not in UNNAMED and code not in known
    ]
    remarks = []
    if missing or unknown:
        without = " or ".join(missing)
        faults = [f"does not name its {without}"] * bool(missing)
        faults += [f"has the {', '.join(unknown)} of H.273, which is not supported"] * bool(unknown)
        by = "" if rgb or frame.colorspace in MATRICES else f" and the matrix of {MATRIX_NAMES[usual]}"
        remarks.append(f"{{}} {', and '.join(faults)}; the colours of {colors}{by} are assumed.")
    elif colors.hdr and colors.primaries == "sRGB":
        remarks.append(f"{{}} is {transfer} with the primaries of SDR, which is unusual; both are followed.")
    full = rgb or frame.color_range == ColorRange.JPEG or frame.format.name.startswith("yuvj")
    return Tags(colors, matrix, ColorRange.JPEG if full else ColorRange.MPEG, tuple(remarks))
