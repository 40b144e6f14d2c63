"""A texture shows at each place of a mesh what its cameras see there, finer than its triangles, and lies in the `.glb`.

How much it gains on a photographed scene is measured by `splatmill bench mesh`.
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatmill_worker.mesh import glb
from splatmill_worker.mesh.colors import UNSEEN, colored
from splatmill_worker.mesh.depths import View
from splatmill_worker.mesh.texture import textured
from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.synthetic.ray_caster import look_at
from tests.worker.mesh.test_triangles import chunks

STRIPES = 8


def wall() -> Mesh:
    """Two triangles: the square from -1 to 1 in the plane z = 0, which faces along z; and one that no view sees."""
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    apart = [[8, 8, 0], [9, 8, 0], [8, 9, 0]]
    return Mesh(np.array(corners + apart, np.float32), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.int32))


def views() -> list[View]:
    """Two cameras before the wall, on which they see stripes along y: red and green in turn from the left."""
    photos = []
    for side in (-0.3, 0.3):
        camera = look_at(np.array([side, 0.1, 4.0]), np.zeros(3), 256, 256, 400.0)
        columns, rows = np.meshgrid(np.arange(256) + 0.5, np.arange(256) + 0.5)
        rays = camera.unproject(columns.ravel(), rows.ravel(), np.ones(256 * 256)) - camera.center
        depth = -camera.center[2] / rays[:, 2]
        x = camera.center[0] + depth * rays[:, 0]
        red = (np.floor((x + 1) / 2 * STRIPES) % 2 == 0)[:, None]
        color = np.where(red, [[200, 40, 30]], [[30, 160, 60]]).reshape(256, 256, 3).astype(np.uint8)
        photos.append(
            View(camera, torch.from_numpy(color), torch.from_numpy(depth.reshape(256, 256)).float())
        )
    return photos


@pytest.fixture(scope="module")
def painted() -> Mesh:
    return textured(colored(wall(), views()), views(), 256)


def at(mesh: Mesh, x: float, y: float) -> np.ndarray:
    """The colour at a place of the wall, by the triangle that holds it."""
    assert mesh.uvs is not None
    assert mesh.texture is not None
    for face in mesh.faces:
        corners = np.concatenate([mesh.vertices[face, :2].T, np.ones((1, 3))])
        shares = np.linalg.solve(corners, [x, y, 1.0])
        if (shares >= -1e-6).all():
            column, row = shares @ mesh.uvs[face] * mesh.texture.shape[1::-1]
            return mesh.texture[int(row), int(column)]
    raise AssertionError("no triangle holds this place")


def test_stripes_finer_than_the_triangles_are_on_the_texture(painted: Mesh) -> None:
    assert painted.colors is None
    assert painted.texture is not None
    assert max(painted.texture.shape) == 256
    for y in (-0.7, 0.05, 0.6):
        for stripe in range(STRIPES):
            expected = (30, 160, 60) if stripe % 2 else (200, 40, 30)
            shown = at(painted, -1 + (stripe + 0.5) * 2 / STRIPES, y)
            assert np.abs(shown.astype(int) - expected).max() <= 3, (stripe, y)


def test_what_no_view_sees_has_the_colour_of_its_vertices(painted: Mesh) -> None:
    assert at(painted, 8.3, 8.3).tolist() == [UNSEEN] * 3


def test_charts_are_continued_beyond_their_edges(painted: Mesh) -> None:
    assert painted.uvs is not None
    assert painted.texture is not None
    # Every texel beside a corner of the wall, also those outside of its chart, has a colour of the wall.
    size = np.array(painted.texture.shape[1::-1])
    used = np.unique(painted.faces[:2])
    for column, row in (painted.uvs[used] * size).astype(int):
        near = painted.texture[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3].reshape(-1, 3)
        assert near.max(axis=1).min() > 100


def test_the_file_holds_the_texture(painted: Mesh, tmp_path: Path) -> None:
    glb.write(tmp_path / "mesh.glb", painted, (0.0, 0.0, 0.0))
    document, binary = chunks((tmp_path / "mesh.glb").read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "TEXCOORD_0"}
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    assert "target" not in view
    stored = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    picture = np.asarray(Image.open(io.BytesIO(stored)))
    assert painted.texture is not None
    assert picture.shape == painted.texture.shape
    assert np.abs(picture.astype(int) - painted.texture).mean() < 4
    assert len(binary) == document["buffers"][0]["byteLength"]


def test_faces_without_area_take_no_texels() -> None:
    mesh = colored(wall(), views())
    flat = replace(mesh, faces=np.concatenate([mesh.faces, [[0, 0, 1]]]).astype(np.int32))
    shown = textured(flat, views(), 256)
    assert at(shown, -0.9, 0.0).argmax() == 0
