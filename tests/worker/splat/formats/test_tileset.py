"""Proves `tileset.json` against its specification: what each tile holds, its box and error, and its place on the earth.

Does not prove that CesiumJS draws it (docs/formats.md says of which version that was seen), nor the levels
(tests/worker/splat/lod), nor the `.spz` in each tile (test_spz.py).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill.schema import GeographicOrigin, ModelFrame
from splatmill_worker.render_service.convert import convert
from splatmill_worker.sfm.world import geodesy
from splatmill_worker.splat.formats import ply, registry, spz, tileset
from splatmill_worker.splat.gaussians import Gaussians, concatenate
from splatmill_worker.splat.lod.boxes import REACH
from splatmill_worker.splat.lod.levels import make_levels
from splatmill_worker.splat.lod.moments import extents
from tests.support.gaussians import matched, some_gaussians
from tests.worker.splat.formats.test_streamed_sog import _scene

Tile = dict[str, Any]
MUNICH = np.array([48.1, 11.5, 520.0])
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From x right, y down, z front to the tiles' x right, y front, z up."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "tileset.json"
    levels = make_levels(_scene(), coarsest=500, leaf=200)
    tileset.write_levels(path, levels, most=400, antialiased=True)
    return path


def _walk(tile: Tile, depth: int = 0) -> Iterator[tuple[Tile, int]]:
    yield tile, depth
    for child in tile.get("children", []):
        yield from _walk(child, depth + 1)


def _contents(folder: Path, tile: Tile, scratch: Path) -> tuple[dict[str, Any], Gaussians, bool]:
    """The document of a tile, and the Gaussians in it in the frame of the `.ply`."""
    data = (folder / tile["content"]["uri"]).read_bytes()
    assert data[:4] == b"glTF"
    assert int.from_bytes(data[8:12], "little") == len(data)
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    (view,) = document["bufferViews"]
    begin = 28 + length + view["byteOffset"]
    scratch.write_bytes(data[begin : begin + view["byteLength"]])
    contents = spz.read(scratch)
    return document, contents.gaussians, bool(contents.antialiased)


def _middle(scene: Gaussians) -> np.ndarray:
    """The middle of the box around Gaussians with their extents."""
    reach = REACH * extents(scene)
    return ((scene.means - reach).amin(0) + (scene.means + reach).amax(0)).numpy() / 2


def _inside(box: list[float], places: np.ndarray) -> bool:
    sides = np.array(box[3:]).reshape(3, 3)
    offsets = (places - box[:3]) @ sides.T / np.square(sides).sum(1)
    return bool((np.abs(offsets) <= 1 + 1e-4).all())


def test_every_level_is_the_whole_scene_in_tiles_that_their_boxes_hold(written: Path, tmp_path: Path) -> None:
    index = json.loads(written.read_text())
    assert index["asset"]["version"] == "1.1"
    counts: dict[int, int] = {}
    finest = []
    for tile, depth in _walk(index["root"]):
        document, gaussians, antialiased = _contents(written.parent, tile, tmp_path / "tile.spz")
        counts[depth] = counts.get(depth, 0) + gaussians.count
        assert antialiased
        assert gaussians.count <= 400
        assert _inside(tile["boundingVolume"]["box"], gaussians.means.numpy() @ UPRIGHT.T)
        for child in tile.get("children", []):
            assert child["geometricError"] < tile["geometricError"] < index["geometricError"]
        if depth == 2:
            assert tile["geometricError"] == 0
            assert "children" not in tile
            finest.append(gaussians)
        (mesh,) = document["meshes"]
        (primitive,) = mesh["primitives"]
        extension = primitive["extensions"]["KHR_gaussian_splatting"]["extensions"]
        assert extension == {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
        assert document["extensionsRequired"] == tileset.EXTENSIONS
        accessors = {name: document["accessors"][at] for name, at in primitive["attributes"].items()}
        assert {accessor["count"] for accessor in accessors.values()} == {gaussians.count}
        assert len(accessors) == 4 + 3  # harmonics of degree 1
        shown = gaussians.means.numpy() * [1, -1, -1]
        np.testing.assert_allclose(accessors["POSITION"]["min"], shown.min(0), atol=1e-2)
    assert counts == {0: 375, 1: 1500, 2: 6000}, "of the surroundings nothing"
    whole = _scene()
    whole = whole.select(whole.means.norm(dim=1) < 20)
    leaves = concatenate(*finest)
    assert float((leaves.means - matched(leaves, whole).means).abs().max()) < 1e-3
    tiles = sum(path.stat().st_size for path in written.parent.glob("tiles/*.glb"))
    assert registry.size(written) == written.stat().st_size + tiles


def test_it_lies_where_the_frame_of_the_model_says(tmp_path: Path) -> None:
    model = tmp_path / "model.ply"
    scene = some_gaussians(50, 0)
    ply.write(model, scene, offset=(100.0, -20.0, 300.0))  # 100 m east, 20 m up, 300 m north
    latitude, longitude, altitude = (float(value) for value in MUNICH)
    frame = ModelFrame(
        unit="metre",
        origin=GeographicOrigin(latitude=latitude, longitude=longitude, altitude=altitude),
        from_sfm=np.eye(4).tolist(),
    )
    (tmp_path / "frame.json").write_text(frame.model_dump_json())
    _, (converted,), notes = convert(model, [tmp_path / "out/tileset.json"], None)
    assert converted.gaussians == 50
    assert any("tileset.json" in note for note in notes)
    root = json.loads((tmp_path / "out/tileset.json").read_text())["root"]
    transform = np.array(root["transform"]).reshape(4, 4).T
    for x, y, z in scene.means[:5].double().numpy():
        point = (transform @ [x, z, -y, 1])[:3]
        place = geodesy.place(np.array([100 + x, 300 + z, 20 - y]), MUNICH)
        np.testing.assert_allclose(point, geodesy.to_earth_centered(place)[:3, 3], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 3])
def test_without_a_place_it_stands_upright_in_its_own_coordinates(tmp_path: Path, degree: int) -> None:
    scene = some_gaussians(50, degree)
    path = tmp_path / "tileset.json"
    offset = (7.0, -2.0, 5.0)
    registry.write(path, scene, offset=offset, up=(0.0, 0.0, 1.0))
    root = json.loads(path.read_text())["root"]
    transform = np.array(root["transform"]).reshape(4, 4).T
    # CesiumJS draws no Gaussians of a node that is rotated.
    document, gaussians, _ = _contents(tmp_path, root, tmp_path / "tile.spz")
    assert document["nodes"] == [{"mesh": 0}]
    assert len(document["meshes"][0]["primitives"][0]["attributes"]) == 4 + (degree + 1) ** 2 - 1
    assert gaussians.count == 50
    # The world of the model has z up, as tiles have.
    for mean in scene.means[:5].double().numpy():
        shown = (transform @ [*(UPRIGHT @ mean), 1])[:3]
        np.testing.assert_allclose(shown, mean + offset, atol=1e-6)
    assert _inside(root["boundingVolume"]["box"], scene.means.numpy() @ UPRIGHT.T)
    np.testing.assert_allclose(root["boundingVolume"]["box"][:3], UPRIGHT @ _middle(scene), atol=1e-5)


def test_a_place_is_that_of_a_model_with_y_down_whatever_its_photos_say(tmp_path: Path) -> None:
    for name, up in (("a", (0.0, 0.0, 1.0)), ("b", None)):
        registry.write(
            tmp_path / name / "tileset.json", some_gaussians(5, 0), up=up, to_earth=np.diag([2.0, 2, 2, 1])
        )
    assert (tmp_path / "a/tileset.json").read_text() == (tmp_path / "b/tileset.json").read_text()


def test_of_no_gaussians_nothing_is_shown(tmp_path: Path) -> None:
    assert registry.write(tmp_path / "tileset.json", some_gaussians(0, 0)) == 0
    root = json.loads((tmp_path / "tileset.json").read_text())["root"]
    assert "content" not in root
    assert np.linalg.det(np.array(root["boundingVolume"]["box"][3:]).reshape(3, 3)) != 0
