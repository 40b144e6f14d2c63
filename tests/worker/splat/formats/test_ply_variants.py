"""Proves that the variants of the `.ply` that other programs write are read with the right values, that what is read
otherwise or left out is reported, and that what has two readings is refused.

Does not prove which programs write them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.render_service import local
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.gaussians import SH_C0, Gaussians
from splatmill_worker.splat.start import given_file
from tests.support.gaussians import some_gaussians

COUNT = 30
FACE = PlyElement.describe(np.array([], dtype=[("vertex_indices", "O")]), "face")

Columns = dict[str, np.ndarray[Any, np.dtype[Any]]]


@pytest.fixture
def scene() -> Gaussians:
    return some_gaussians(COUNT, 3)


@pytest.fixture
def columns(scene: Gaussians, tmp_path: Path) -> Columns:
    """The properties of the scene in a `.ply` as it is written here, by name."""
    ply.write(tmp_path / "own.ply", scene)
    rows = PlyData.read(str(tmp_path / "own.ply"), mmap=False)["vertex"].data
    return {name: rows[name] for name in rows.dtype.names}


def stored(path: Path, columns: Columns, *others: PlyElement, text: bool = False, comment: str = "") -> Path:
    rows = np.zeros(len(columns["x"]), [(name, column.dtype.str) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    elements = [PlyElement.describe(rows, "vertex"), *others]
    PlyData(elements, text=text, byte_order="<", comments=[comment] if comment else []).write(str(path))
    return path


def colored(columns: Columns, largest: float, dtype: str) -> Columns:
    """The properties with red, green and blue in place of the f_dc, the brightest of which is `largest`."""
    kept = {name: column for name, column in columns.items() if not name.startswith("f_")}
    for index, channel in enumerate(("red", "green", "blue")):
        shown = np.clip(columns[f"f_dc_{index}"] * SH_C0 + 0.5, 0, 1) * largest
        kept[channel] = (shown if dtype.startswith("f") else np.round(shown)).astype(dtype)
    return kept


@pytest.mark.parametrize(
    ("largest", "dtype", "error"),
    [(255, "u1", 0.51 / 255), (65535, "u2", 1e-5), (1, "f4", 1e-6), (1, "f8", 1e-6)],
)
@pytest.mark.parametrize("text", [False, True])
def test_colours_of_red_green_and_blue(
    scene: Gaussians, columns: Columns, tmp_path: Path, largest: float, dtype: str, error: float, text: bool
) -> None:
    read = registry.read(stored(tmp_path / "rgb.ply", colored(columns, largest, dtype), text=text))
    shown = read.gaussians.sh[:, 0] * SH_C0 + 0.5
    assert float((shown - (scene.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)).abs().max()) < error
    assert read.gaussians.degree == 0
    assert torch.allclose(read.gaussians.means, scene.means, atol=1e-6)
    assert [note for note in read.notes if "red, green and blue" in note]


def test_the_harmonics_win_over_colours_of_points(scene: Gaussians, columns: Columns, tmp_path: Path) -> None:
    read = registry.read(stored(tmp_path / "both.ply", {**colored(columns, 255, "u1"), **columns}))
    assert torch.equal(read.gaussians.sh, scene.sh)
    assert read.notes == ()


@pytest.mark.parametrize(
    ("largest", "dtype", "says"),
    [(255, "f4", "floats from .* to 2.*0 to 1 are read"), (255, "i4", "types i4")],
)
def test_colours_that_have_two_readings_are_refused(
    columns: Columns, tmp_path: Path, largest: float, dtype: str, says: str
) -> None:
    path = stored(tmp_path / "rgb.ply", colored(columns, largest, dtype))
    with pytest.raises(ModelUnreadable, match=says):
        registry.read(path)


def test_gaussians_of_two_scales_are_flat(scene: Gaussians, columns: Columns, tmp_path: Path) -> None:
    del columns["scale_2"]
    read = registry.read(stored(tmp_path / "2dgs.ply", columns))
    assert torch.equal(read.gaussians.log_scales[:, :2], scene.log_scales[:, :2])
    sizes = read.gaussians.log_scales.exp()
    assert torch.allclose(sizes[:, 2], sizes[:, :2].amin(dim=1) / 1000)
    assert read.antialiased is None
    assert "2D Gaussians" in read.notes[0]


@pytest.mark.parametrize("gone", [("scale_1",), ("scale_1", "scale_2"), ("scale_2", "rot_3"), ("opacity",)])
def test_what_else_is_missing_is_named(columns: Columns, tmp_path: Path, gone: tuple[str, ...]) -> None:
    for name in gone:
        del columns[name]
    path = stored(tmp_path / "less.ply", columns)
    with pytest.raises(ModelUnreadable, match=f"{gone[-1]} are missing"):
        registry.read(path)


def of_degree(columns: Columns, scene: Gaussians, degree: int) -> Columns:
    """The properties with harmonics of `degree`, which are 9 above degree 3."""
    each = (degree + 1) ** 2 - 1
    rest = np.full((COUNT, 3, each), 9, np.float32)
    rest[:, :, :15] = scene.sh[:, 1:].transpose(1, 2)
    kept = {name: column for name, column in columns.items() if not name.startswith("f_rest")}
    return kept | {f"f_rest_{i}": rest.reshape(COUNT, -1)[:, i] for i in range(3 * each)}


@pytest.mark.parametrize("degree", [4, 5])
def test_harmonics_above_degree_3_are_left_out(
    scene: Gaussians, columns: Columns, tmp_path: Path, degree: int
) -> None:
    read = registry.read(stored(tmp_path / "sh.ply", of_degree(columns, scene, degree)))
    assert torch.equal(read.gaussians.sh, scene.sh)
    assert read.notes == (f"Its harmonics of degree {degree} are read to degree 3.",)


def test_harmonics_of_degree_4_in_a_compressed_file_are_left_out(scene: Gaussians, tmp_path: Path) -> None:
    registry.write(tmp_path / "m.compressed.ply", scene)
    right = registry.read(tmp_path / "m.compressed.ply")
    document = PlyData.read(str(tmp_path / "m.compressed.ply"), mmap=False)
    three = document["sh"].data
    levels = np.full((COUNT, 3, 24), 255, np.uint8)
    levels[:, :, :15] = np.stack([three[f"f_rest_{i}"] for i in range(45)], 1).reshape(COUNT, 3, 15)
    rows = np.zeros(COUNT, [(f"f_rest_{i}", "u1") for i in range(72)])
    for i in range(72):
        rows[f"f_rest_{i}"] = levels.reshape(COUNT, 72)[:, i]
    elements = [document["chunk"], document["vertex"], PlyElement.describe(rows, "sh")]
    PlyData(elements, byte_order="<").write(str(tmp_path / "four.ply"))
    read = registry.read(tmp_path / "four.ply")
    assert torch.equal(read.gaussians.sh, right.gaussians.sh)
    assert "degree 4" in read.notes[0]


@pytest.mark.parametrize("text", [False, True])
def test_an_element_without_rows_is_left_out(
    scene: Gaussians, columns: Columns, tmp_path: Path, text: bool
) -> None:
    read = registry.read(stored(tmp_path / "faces.ply", columns, FACE, text=text))
    assert torch.allclose(read.gaussians.means, scene.means, atol=1e-6)
    assert read.notes == ()


def test_no_gaussians_are_read_of_every_variant(scene: Gaussians, columns: Columns, tmp_path: Path) -> None:
    flat = {name: column for name, column in columns.items() if name != "scale_2"}
    for variant in (columns, flat, colored(columns, 1, "f4"), of_degree(columns, scene, 4)):
        path = stored(tmp_path / "none.ply", {name: column[:0] for name, column in variant.items()}, FACE)
        assert registry.read(path).gaussians.count == 0


def test_commands_and_training_say_what_is_read_otherwise(
    columns: Columns, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del columns["scale_2"]
    path = stored(tmp_path / "m.ply", columns, comment="SplatRenderMode: fog")
    local.read(path)
    said = capsys.readouterr().err.splitlines()
    assert [line.split(" ")[0] for line in said] == ["m.ply:", "m.ply:"]
    assert "2D Gaussians" in said[0]
    assert "'fog' is not known" in said[1]
    answer: dict[str, Any] = given_file.read(path, 10)
    assert [f"m.ply: {note}" for note in answer["notes"]] == said
