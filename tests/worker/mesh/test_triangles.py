"""Pieces of meshes, fewer triangles, and files: what is written is read again, by this program and by other readers."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill_worker.mesh import glb, ply
from splatmill_worker.mesh.triangles import Mesh, simplified, without_specks


def tetrahedron(scale: float, at: float) -> Mesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) * scale + np.float32(at)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return Mesh(corners, faces, np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 100, 200]], np.uint8))


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    colors = np.concatenate([mesh.colors for mesh in meshes if mesh.colors is not None])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), faces.astype(np.int32), colors)


def test_pieces_of_less_than_a_share_are_left_out_with_their_vertices() -> None:
    large, middle, speck = tetrahedron(1.0, 0.0), tetrahedron(0.5, 3.0), tetrahedron(0.05, 6.0)
    whole = together(speck, large, middle)
    kept = without_specks(whole, 0.01)
    assert (len(kept.vertices), len(kept.faces)) == (8, 8)
    assert np.array_equal(np.sort(kept.vertices[:, 0]), np.sort(together(large, middle).vertices[:, 0]))
    assert kept.colors is not None
    assert large.colors is not None
    assert np.array_equal(kept.colors[:4], large.colors)
    assert len(without_specks(whole, 0.5).faces) == 4
    assert len(without_specks(whole, 1e-9).faces) == 12


def test_a_long_strip_is_one_piece() -> None:
    n = 5000
    vertices = np.stack([np.arange(n), np.arange(n) % 2, np.zeros(n)], 1).astype(np.float32)
    order = np.random.default_rng(0).permutation(n)
    faces = np.stack([np.arange(n - 2), np.arange(1, n - 1), np.arange(2, n)], 1)
    place = np.argsort(order)
    mesh = Mesh(vertices[order], place[faces].astype(np.int32))
    assert len(without_specks(mesh, 0.999).faces) == n - 2


def sphere(times: int) -> Mesh:
    """A unit ball: an octahedron whose faces are divided into four so many times."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64)
    octants = [(x, y, z) for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    faces = np.array([(x, y, z) if (x + y + z) % 2 else (x, z, y) for x, y, z in octants])
    triangles = corners[faces]
    for _ in range(times):
        a, b, c = triangles.swapaxes(0, 1)
        ab, bc, ca = (
            (p + q) / np.linalg.norm(p + q, axis=1, keepdims=True) for p, q in ((a, b), (b, c), (c, a))
        )
        triangles = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3, 3)
    vertices, numbers = np.unique(triangles.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    return Mesh(vertices.astype(np.float32), numbers.reshape(-1, 3).astype(np.int32))


def test_fewer_triangles_keep_the_ball() -> None:
    whole = sphere(5)
    assert len(whole.faces) == 8192
    fewer = simplified(whole, 2000)
    assert 1500 < len(fewer.faces) <= 2000
    radii = np.linalg.norm(fewer.vertices, axis=1)
    assert np.abs(radii - 1.0).max() < 0.01
    assert ((fewer.normals() * fewer.vertices).sum(1) > 0).all()
    assert simplified(whole, len(whole.faces)) is whole


def test_a_ply_is_read_again(tmp_path: Path) -> None:
    mesh = tetrahedron(1.0, 0.25)
    ply.write(tmp_path / "mesh.ply", mesh.vertices, mesh.faces, mesh.colors, ("offset 1 2 3",))
    for before, after in zip(
        (mesh.vertices, mesh.faces, mesh.colors), ply.read(tmp_path / "mesh.ply"), strict=True
    ):
        assert before is not None
        assert after is not None
        assert np.array_equal(before, after)
    assert b"comment offset 1 2 3" in (tmp_path / "mesh.ply").read_bytes()
    ply.write(tmp_path / "bare.ply", mesh.vertices, mesh.faces, None)
    assert ply.read(tmp_path / "bare.ply")[2] is None


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (5e5, 4e6, 100.0)])
def test_a_glb_holds_the_mesh_with_y_up_and_linear_colours(
    tmp_path: Path, offset: tuple[float, float, float]
) -> None:
    mesh = tetrahedron(2.0, 0.5)
    glb.write(tmp_path / "mesh.glb", mesh, offset)
    document, data = chunks((tmp_path / "mesh.glb").read_bytes())
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 4
    assert primitive.get("extras") == ({"offset": list(offset)} if any(offset) else None)
    positions = values(document, data, primitive["attributes"]["POSITION"], "<f4")
    assert np.array_equal(positions, mesh.vertices * [1, -1, -1])
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    assert accessor["min"] == positions.min(0).tolist()
    assert accessor["max"] == positions.max(0).tolist()
    faces = values(document, data, primitive["indices"], "<u4").reshape(-1, 3)
    assert np.array_equal(faces, mesh.faces)
    colors = values(document, data, primitive["attributes"]["COLOR_0"], "<u2") / 65535
    assert mesh.colors is not None
    shown = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
    assert np.array_equal((shown[:, :3] * 255).round(), mesh.colors)
    assert (colors[:, 3] == 1).all()
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}


def chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk, by the lengths that the file gives."""
    magic, version, total, length, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
    rest, kind = struct.unpack("<I4s", content[20 + length : 28 + length])
    assert kind == b"BIN\0"
    assert 28 + length + rest == total
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def values(document: dict[str, Any], data: bytes, number: int, kind: str) -> np.ndarray:
    """The values of an accessor."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    part = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(part, kind).reshape(accessor["count"], width)
