"""Proves the `.ply` layout byte for byte, reading by name, and that nothing unfit is ever written.

Does not prove that other programs accept the file; only plyfile, a reader that is not ours, is asked.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.gaussians import Gaussians


def some_gaussians(n: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(normal(n, 3), normal(n, 3) - 3, normal(n, 4), normal(n), normal(n, (degree + 1) ** 2, 3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_survives_the_file(tmp_path: Path, degree: int) -> None:
    before = some_gaussians(17, degree)
    assert ply.write(tmp_path / "m.ply", before) == 17
    after = ply.read(tmp_path / "m.ply").gaussians
    assert after.degree == degree
    for name, value in before.parameters().items():
        if name != "quats":
            assert torch.equal(after.parameters()[name], value), name
    unit = before.quats / before.quats.norm(dim=1, keepdim=True)
    assert torch.allclose(after.quats, unit, atol=1e-6)
    assert torch.allclose(after.quats.norm(dim=1), torch.ones(17), atol=1e-6)


def test_the_layout_is_the_one_viewers_read(tmp_path: Path) -> None:
    scene = some_gaussians(3, 3)
    ply.write(tmp_path / "m.ply", scene)
    raw = (tmp_path / "m.ply").read_bytes()
    header, body = raw.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 3" in lines
    properties = [line.split() for line in lines if line.startswith("property")]
    assert all(kind == "float" for _, kind, _ in properties)
    names = [name for _, _, name in properties]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.frombuffer(body, "<f4").reshape(3, 62)
    # Channel-major: the 15 red coefficients come first.
    assert np.array_equal(table[:, 9:24], scene.sh[:, 1:, 0].numpy())
    assert np.array_equal(table[:, 24:39], scene.sh[:, 1:, 1].numpy())
    assert np.array_equal(table[:, 3:6], np.zeros((3, 3)))


def test_a_model_of_several_pieces_has_all_its_rows_in_order(tmp_path: Path) -> None:
    scene = some_gaussians(2 * ply.PIECE + 5, 0)
    scene.logit_opacities[:] = 1.0
    scene.means[[0, ply.PIECE, 2 * ply.PIECE + 4]] = math.nan
    assert ply.write(tmp_path / "m.ply", scene) == scene.count - 3
    assert torch.equal(ply.read(tmp_path / "m.ply").gaussians.means, scene.means[scene.finite()])


def test_degrees_are_padded_on_request(tmp_path: Path) -> None:
    ply.write(tmp_path / "m.ply", some_gaussians(5, 1), degree=3)
    after = ply.read(tmp_path / "m.ply").gaussians
    assert after.degree == 3
    assert torch.equal(after.sh[:, 4:], torch.zeros(5, 12, 3))


def test_what_is_unfit_is_left_out(tmp_path: Path) -> None:
    scene = some_gaussians(8, 1)
    scene.logit_opacities[:] = 0.0
    scene.means[0, 1] = math.nan
    scene.log_scales[1, 2] = math.inf
    scene.sh[2, 3, 1] = -math.inf
    scene.quats[3] = 0.0
    scene.logit_opacities[4] = math.log(1 / 256) - math.log(1 - 1 / 256)
    assert ply.write(tmp_path / "m.ply", scene) == 3
    after = ply.read(tmp_path / "m.ply").gaussians
    assert torch.equal(after.means, scene.means[5:])
    assert bool(after.finite().all())


def test_any_order_of_properties_and_extra_ones_are_read(tmp_path: Path) -> None:
    scene = some_gaussians(4, 1)
    ply.write(tmp_path / "ours.ply", scene)
    vertex = PlyData.read(str(tmp_path / "ours.ply"))["vertex"]
    names = [p.name for p in vertex.properties if not p.name.startswith("n")][::-1]
    table = np.zeros(4, dtype=[("label", "u1"), *((name, "f8") for name in names)])
    for name in names:
        table[name] = vertex[name]
    PlyData([PlyElement.describe(table, "vertex")], text=True).write(str(tmp_path / "theirs.ply"))
    after = ply.read(tmp_path / "theirs.ply").gaussians
    assert torch.allclose(after.sh, scene.sh, atol=1e-6)
    assert torch.allclose(after.means, scene.means, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"hello", "could not be read"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
            "rot_3 are missing",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n0 0 0\n",
            "it holds points alone, a cloud or a mesh",
        ),
        (b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n", "no vertex element"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n\0\0",
            "announces 9 vertex rows of 4 bytes or more, and 2 bytes follow: it is cut off",
        ),
    ],
)
def test_what_is_no_splat_file_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(ModelUnreadable, match=says):
        ply.read(tmp_path / "bad.ply")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ply.write(tmp_path / "m.ply", some_gaussians(2, 0))
    before = (tmp_path / "m.ply").read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        ply.write(tmp_path / "m.ply", some_gaussians(3, 0))
    assert (tmp_path / "m.ply").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.ply"]
