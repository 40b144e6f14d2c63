"""Proves the compressed `.ply` against splat-transform in both directions, its error bounds, and what is refused.

Does not prove how a converted model looks: tests of the command `convert` measure that.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import compressed_ply, ply, registry
from tests.support.files.splat_transform import convert
from tests.support.gaussians import differences, matched, some_gaussians
from tests.support.paths import DATA

OTHERS = DATA / "splats"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_survives_within_the_steps_of_the_format(tmp_path: Path, degree: int) -> None:
    before = some_gaussians(600, degree)
    before.sh[7] = 30.0  # the DC colour is kept, harmonics end at 4
    assert compressed_ply.write(tmp_path / "m.compressed.ply", before) == 600
    after = compressed_ply.read(tmp_path / "m.compressed.ply").gaussians
    before.sh[7, 1:] = 4.0
    errors = differences(after, matched(after, before))
    extent = float((before.means.amax(dim=0) - before.means.amin(dim=0)).max())
    assert errors["means"] <= extent / 1023 / 2 * 1.01
    assert errors["log_scales"] <= 10 / 1023 / 2 * 1.01
    assert errors["quats"] < 4e-6  # three components in steps of 1 / 723
    assert errors["opacities"] <= 1 / 255 / 2 * 1.01
    assert errors["harmonics"] <= 8 / 256 / 2 * 1.01
    assert errors["dc"] <= 32 / 255 / 2


def test_a_file_has_sixteen_bytes_a_gaussian_and_the_header_that_others_read(tmp_path: Path) -> None:
    scene = some_gaussians(513, 0)
    data = compressed_ply.encode(scene)
    header, body = data.split(b"end_header\n", 1)
    assert len(body) == 3 * 18 * 4 + 513 * 16
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (tmp_path / "m.ply").write_bytes(data)
    document = PlyData.read(str(tmp_path / "m.ply"))
    assert [(element.name, element.count) for element in document.elements] == [("chunk", 3), ("vertex", 513)]
    chunk = document["chunk"]
    assert np.min(chunk["min_x"]) == float(scene.means[:, 0].min())
    assert np.max(chunk["max_scale_z"]) == float(scene.log_scales[:, 2].max())


def test_what_is_unfit_is_left_out_and_nothing_at_all_is_a_file_too(tmp_path: Path) -> None:
    scene = some_gaussians(300, 1)
    scene.means[3, 1] = torch.nan
    scene.sh[4, 2, 0] = torch.inf
    scene.logit_opacities[5] = -9.0
    assert compressed_ply.write(tmp_path / "m.compressed.ply", scene) == 297
    assert registry.read(tmp_path / "m.compressed.ply").gaussians.count == 297
    assert compressed_ply.write(tmp_path / "none.compressed.ply", scene.select(torch.arange(0))) == 0
    assert registry.read(tmp_path / "none.compressed.ply").gaussians.count == 0


def test_splat_transform_reads_what_we_write(tmp_path: Path) -> None:
    scene = some_gaussians(700, 3)
    compressed_ply.write(tmp_path / "ours.compressed.ply", scene)
    convert(tmp_path / "ours.compressed.ply", tmp_path / "theirs.ply")
    errors = differences(
        ply.read(tmp_path / "theirs.ply").gaussians, registry.read(tmp_path / "ours.compressed.ply").gaussians
    )
    assert max(errors.values()) < 1e-5


def test_we_read_what_splat_transform_writes(tmp_path: Path) -> None:
    scene = some_gaussians(700, 3)
    ply.write(tmp_path / "ours.ply", scene)
    convert(tmp_path / "ours.ply", tmp_path / "theirs.compressed.ply")
    compressed_ply.write(tmp_path / "ours.compressed.ply", scene)
    ours, theirs = (
        registry.read(tmp_path / name).gaussians for name in ("ours.compressed.ply", "theirs.compressed.ply")
    )
    # No further from the scene than our own file is.
    own, foreign = differences(ours, matched(ours, scene)), differences(theirs, matched(theirs, scene))
    assert all(foreign[name] < own[name] * 1.5 + 1e-6 for name in own)


@pytest.mark.skipif(not OTHERS.is_dir(), reason="needs ../shared/data/splats")
def test_a_file_of_supersplat_is_read_and_written_again_without_loss(tmp_path: Path) -> None:
    """A second pass of the same quantisation loses next to nothing."""
    first = registry.read(OTHERS / "guitar.compressed.ply").gaussians
    assert (first.count, first.degree) == (90_854, 0)
    registry.write(tmp_path / "again.compressed.ply", first)
    again = registry.read(tmp_path / "again.compressed.ply").gaussians
    assert again.count == first.count
    assert torch.allclose(again.means.mean(dim=0), first.means.mean(dim=0), atol=1e-5)
    assert torch.allclose(again.sh.mean(dim=0), first.sh.mean(dim=0), atol=1e-4)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    data = compressed_ply.encode(some_gaussians(300, 1))
    path = tmp_path / "m.compressed.ply"
    for broken, says in (
        (data[:-20], "its header announces 300 sh rows"),
        (data.replace(b"element chunk 2", b"element chunk 1"), "could not be read|are too few"),
        (data.replace(b"min_scale_x", b"min_scale_q"), "chunk lacks min_scale_x"),
        (data.replace(b"packed_color", b"packed_clear"), "vertex lacks packed_color"),
        (data.replace(b"element chunk", b"element clump"), "not a 3D Gaussian .ply"),
    ):
        path.write_bytes(broken)
        with pytest.raises(ModelUnreadable, match=says):
            registry.read(path)


def test_an_offset_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "m.compressed.ply"
    compressed_ply.write(path, some_gaussians(3, 0), offset=(450_000.0, -7.0, 0.0))
    assert registry.read(path).offset == (450_000.0, -7.0, 0.0)
