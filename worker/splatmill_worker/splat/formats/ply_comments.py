"""Comments in the header of a `.ply` of either form that say where its model lies and how it is to be drawn.

`SplatRenderMode: mip` is what Brush writes; PlayCanvas, SuperSplat and splat-transform read it. Postshot writes
`postshot.anti_aliasing=1`.
"""

from __future__ import annotations

import re
from pathlib import Path

from plyfile import PlyData

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats.contents import NO_OFFSET, Offset

_MODES = {"mip": True, "default": False, "2dgs": False}
"""Whether a Gaussian of each render mode is drawn with the low-pass filter of Mip-Splatting. Those of 2DGS are not."""

_MODE = re.compile(r"\s*SplatRenderMode\s*:\s*(\S+)", re.IGNORECASE)
_FLAG = re.compile(r"\s*(?:postshot\.anti_aliasing\s*=|antialiased\s)\s*([01])\s*$", re.IGNORECASE)


def comments_of(offset: Offset, antialiased: bool) -> list[str]:
    """The comments of a file: how it is drawn, and its offset where it is not zero."""
    mode = f"SplatRenderMode: {'mip' if antialiased else 'default'}"
    return [mode, *(["offset " + " ".join(f"{value:.0f}" for value in offset)] if any(offset) else [])]


def offset_of(path: Path, document: PlyData) -> Offset:
    """The offset in the comments of a header. Raises ModelUnreadable where one does not hold three numbers."""
    for comment in document.comments:
        words = comment.split()
        if words[:1] == ["offset"]:
            try:
                x, y, z = (float(word) for word in words[1:])
            except ValueError as error:
                raise ModelUnreadable(
                    f"{path.name} has an offset without three numbers in its header: {comment!r}."
                ) from error
            return x, y, z
    return NO_OFFSET


def unknown_modes(document: PlyData) -> tuple[str, ...]:
    """A sentence for each render mode in the comments that is not known."""
    modes = [match[1] for comment in document.comments if (match := _MODE.match(comment))]
    return tuple(
        f"Its SplatRenderMode {mode[:40]!r} is not known, and says nothing of how it is drawn."
        for mode in modes
        if mode.lower() not in _MODES
    )


def antialiased_of(document: PlyData) -> bool | None:
    """Whether the comments say that the model is drawn antialiased, by the last that does; None where none does."""
    said = None
    for comment in [*document.comments, *document.obj_info]:
        if match := _MODE.match(comment):
            said = _MODES.get(match[1].lower())
        elif match := _FLAG.match(comment):
            said = match[1] == "1"
    return said
