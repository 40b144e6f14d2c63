"""Writes binary glTF 2.0: the document, and one buffer with an array for each accessor.

Source: Khronos, glTF 2.0, section 4.4 (binary files).
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.files import replacing

MAGIC, VERSION, JSON, BIN = b"glTF", 2, b"JSON", b"BIN\0"
ASSET = {"version": "2.0", "generator": "Splatmill"}
TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
COMPONENTS: dict[int, tuple[str, float]] = {
    5120: ("<i1", 127),
    5121: ("<u1", 255),
    5122: ("<i2", 32767),
    5123: ("<u2", 65535),
    5126: ("<f4", 1),
}
"""Component types of attributes: numpy's name, and what a normalized value is divided by."""

Up = tuple[float, float, float]
"""A unit vector that points up, in the frame of a `.ply`."""

UPRIGHT = {"upright": True}
"""Extras of a node that is turned for programs to show it upright; what is in it has the frame of its cameras."""

_ATTRIBUTES, _INDICES = 34962, 34963
_KINDS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}


@dataclass
class Parts:
    """The binary chunk, an array for each accessor, with what the document says of them."""

    arrays: list[npt.NDArray[np.generic]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    length: int = 0

    def add(
        self,
        values: npt.NDArray[Any],
        *,
        bounds: bool = False,
        normalized: bool = False,
        indices: bool = False,
    ) -> int:
        """Append [N, 1 to 4] values, in rows of a multiple of four bytes, and return their accessor's index."""
        array = np.ascontiguousarray(values)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": _KINDS[array.dtype.name],
            "count": array.shape[0],
            "type": {width: name for name, width in TYPES.items()}[array.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        if bounds and array.shape[0]:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        target = _INDICES if indices else _ATTRIBUTES
        self._append(array, target=target)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_file(self, contents: bytes) -> int:
        """Append a file, such as a picture, and return its buffer view's index."""
        self._append(np.frombuffer(contents + bytes(-len(contents) % 4), np.uint8), size=len(contents))
        return len(self.views) - 1

    def _append(self, array: npt.NDArray[Any], *, size: int | None = None, target: int | None = None) -> None:
        """Append an array, of which `size` bytes count, with a multiple of four bytes, as glTF asks for."""
        view = {"buffer": 0, "byteOffset": self.length, "byteLength": array.nbytes if size is None else size}
        self.views.append(view if target is None else view | {"target": target})
        self.arrays.append(array)
        self.length += array.nbytes

    def document(self) -> dict[str, Any]:
        """The members of a document that describe the parts."""
        return {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }


def node(up: Up | None) -> dict[str, Any]:
    """The node of the first mesh, whose vertices are those of a `.ply` turned about x by 180 degrees, so that -y is y.

    up: where that is not what points up, the node turns it to y, by the shortest rotation. None: not known.
    """
    if up is None:
        return {"mesh": 0}
    x, y, z = up[0], -up[1], -up[2]
    if y > 1.0 - 1e-9:
        return {"mesh": 0}
    # The quaternion (x, y, z, w) from u to y: (u x y, 1 + u . y), of length 1; for u = -y, half a turn about x.
    turn = np.array([-z, 0.0, x, 1.0 + y]) if y > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
    turn /= np.linalg.norm(turn)
    return {"mesh": 0, "rotation": [float(value) for value in turn], "extras": UPRIGHT}


def write(path: Path, document: dict[str, Any], parts: Parts | None, what: str) -> None:
    """Write a document with its parts, if it has any. The file is replaced atomically and synced.

    what: the contents for an error. Raises ValueError for 4 GiB or more.
    """
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + (8 + parts.length if parts else 0)
    if total >= 2**32:
        raise ValueError(f"{what} take {total} bytes, and a .glb holds less than 4 GiB.")
    with replacing(path, sync=True) as part, part.open("wb") as stream:
        stream.write(struct.pack("<4sII", MAGIC, VERSION, total))
        stream.write(struct.pack("<I4s", len(text), JSON) + text)
        if parts:
            stream.write(struct.pack("<I4s", parts.length, BIN))
            for array in parts.arrays:
                stream.write(array.tobytes())


def linear(shown: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    """Linear light of sRGB values from 0 to 1: what COLOR_0 holds."""
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
