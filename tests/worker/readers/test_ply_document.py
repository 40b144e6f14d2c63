"""Proves that a `.ply` is read with the right values whatever its program writes around them: comments in any encoding,
line ends, lists and elements before, in and behind the vertices, either byte order, text, and doubles; as a model and
as points. Damaged lists are refused.

Does not prove that reading is bounded in memory; tests/worker/sfm/posed/test_model_files.py does.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.readers import point_file
from splatmill_worker.splat.formats import ply, registry

NAMES = ["x", "y", "z", *ply.property_names(0)[6:]]
ROWS = np.random.default_rng(0).normal(size=(5, len(NAMES))).astype(np.float32)


@dataclass
class Written:
    """A .ply of ROWS: its form, the type of its values, its line end, and what lies around the vertices."""

    form: str = "binary_little_endian"
    kind: str = "float"
    end: bytes = b"\n"
    comment: bytes = b"made by a program"
    before: bool = False
    inside: bool = False
    behind: bool = False

    def content(self) -> bytes:
        faces = [b"element face 2", b"property list uchar int vertex_indices", b"property uchar flags"]
        head = [b"ply", b"format %s 1.0" % self.form.encode(), b"comment " + self.comment, b"obj_info n 5"]
        head += faces if self.before else []
        head += [b"comment end_header is not here", b"element vertex %d" % len(ROWS)]
        head += [b"property list uchar uint views"] if self.inside else []
        head += [f"property {self.kind} {name}".encode() for name in NAMES]
        head += [b"property list ushort float weights"] if self.inside else []
        head += [line.replace(b"face", b"facets") for line in faces] if self.behind else []
        return self.end.join([*head, b"end_header", b""]) + self._body()

    def _body(self) -> bytes:
        face: list[tuple[str, float]] = [("B", 3), ("i", 0), ("i", 1), ("i", 2), ("B", 9)]
        rows: list[list[tuple[str, float]]] = [face, [("B", 0), ("B", 9)]] if self.before else []
        for number, row in enumerate(ROWS):
            views: list[tuple[str, float]] = (
                [("B", number), *(("I", 1) for _ in range(number))] if self.inside else []
            )
            weights = [("H", 1), ("f", 0.5)] if self.inside else []
            rows.append([*views, *((self.kind[0], float(value)) for value in row), *weights])
        rows += [face] if self.behind else []  # the second one is cut off
        if self.form == "ascii":
            return b"".join(" ".join(f"{value}" for _, value in row).encode() + self.end for row in rows)
        order = ">" if self.form.endswith("big_endian") else "<"
        return b"".join(struct.pack(order + code, value) for row in rows for code, value in row)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    "around",
    [
        {"comment": "Größe — 写真".encode()},
        {"comment": "Größe".encode("latin-1")},
        {"end": b"\r\n"},
        {"end": b"\r"},
        {"kind": "double", "behind": True},
        {"before": True},
        {"inside": True, "before": True, "behind": True, "comment": "é".encode()},
    ],
    ids=lambda around: " ".join(f"{key}={value!r}" for key, value in around.items()),
)
def test_what_programs_write_around_the_vertices_changes_no_value(
    tmp_path: Path, form: str, around: dict[str, Any]
) -> None:
    path = tmp_path / "m.ply"
    path.write_bytes(Written(form, **around).content())
    model = registry.read(path).gaussians
    assert np.allclose(model.means.numpy(), ROWS[:, :3], atol=1e-6)
    assert np.allclose(model.sh[:, 0].numpy(), ROWS[:, 3:6], atol=1e-6)
    assert np.allclose(model.quats.numpy(), ROWS[:, 10:], atol=1e-6)
    points, colors = point_file.read(path)
    assert np.allclose(points, ROWS[:, :3], atol=1e-6)
    assert (colors == 128).all()


def test_comments_that_are_not_ascii_do_not_hide_how_a_model_is_drawn(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_bytes(Written(comment="é\ncomment SplatRenderMode: mip".encode()).content())
    assert registry.read(tmp_path / "m.ply").antialiased is True


@pytest.mark.parametrize(
    ("kind", "value", "name"),
    [("uchar", 51, "red"), ("ushort", 13107, "red"), ("float", 0.2, "red"), ("uchar", 51, "diffuse_red")],
)
def test_colours_of_points(tmp_path: Path, kind: str, value: float, name: str) -> None:
    channels = [name.replace("red", each) for each in ("red", "green", "blue")]
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    head += [f"property {kind} {channel}" for channel in channels]
    most = {"uchar": 255, "ushort": 65535, "float": 1}[kind]
    rows = [f"0 0 0 {value} 0 0", f"0 0 1 {most} {most} {most}", ""]
    (tmp_path / "p.ply").write_text("\n".join([*head, "end_header", *rows]))
    assert point_file.read(tmp_path / "p.ply")[1].tolist() == [[51, 0, 0], [255, 255, 255]]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (
            Written(before=True).content().replace(b"\x03\0\0\0\0\x01", b"\xff\0\0\0\0\x01"),
            "ends in row 0 of 2 face rows",
        ),
        (Written(inside=True).content()[:-3], "ends in row 4 of 5 vertex rows"),
        (Written("ascii", inside=True).content().replace(b"\n0 ", b"\n99999999999 ", 1), "too few"),
        (
            Written()
            .content()
            .replace(b"list uchar", b"list float")
            .replace(b"float x", b"list float int x"),
            "line",
        ),
        (Written().content().replace(b"vertex", b"points"), "no vertex element; its elements are: points"),
    ],
)
def test_damaged_lists_are_refused(tmp_path: Path, data: bytes, says: str) -> None:
    (tmp_path / "m.ply").write_bytes(data)
    with pytest.raises(ModelUnreadable, match=says):
        registry.read(tmp_path / "m.ply")
    with pytest.raises(ValueError, match=says):
        point_file.read(tmp_path / "m.ply")


@pytest.mark.timeout(20)
def test_a_pipe_keeps_no_reader_waiting(tmp_path: Path) -> None:
    for name in ("m.ply", "m.splat", "m.spz"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(ModelUnreadable, match="not a regular file"):
            registry.read(tmp_path / name)
    with pytest.raises(ValueError, match="not a regular file"):
        point_file.read(tmp_path / "m.ply")
