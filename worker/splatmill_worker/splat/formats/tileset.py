"""3D Tiles 1.1: a model in levels of detail as a `tileset.json` with a `.glb` for each tile, at its place on the earth.

Source: OGC 22-025r4, 3D Tiles 1.1; Khronos, KHR_gaussian_splatting, and KHR_gaussian_splatting_compression_spz_2, in
whose form CesiumJS reads Gaussians: each `.glb` holds an `.spz`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatmill.files import atomic_write
from splatmill_worker.splat.formats import glb, gltf, spz
from splatmill_worker.splat.formats.contents import NO_OFFSET, Offset, visible
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.lod.boxes import leaf_boxes
from splatmill_worker.splat.lod.levels import Levels, make_levels
from splatmill_worker.splat.lod.partition import Node

MOST = 32768
"""Gaussians of a tile at most, unless a leaf has more: about 0.7 MB."""

PIXELS = 16.0
"""The error on the screen, in pixels, up to which viewers show a tile by default. All errors are multiplied by it, so
that the next level is loaded once the error of a tile reaches one pixel."""

THINNEST = 1e-3
"""Sides of a box at least, as viewers divide by them."""

FOLDER = "tiles"
"""Beside the index: the folder of the tiles."""

COMPRESSED = "KHR_gaussian_splatting_compression_spz_2"
EXTENSIONS = [glb.EXTENSION, COMPRESSED]

Float = npt.NDArray[np.float64]

FROM_GLTF: Float = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the frame of glTF, y up, to that of tiles, z up: viewers turn the content of a tile by it."""

TURN: Float = FROM_GLTF @ np.diag([1.0, -1.0, -1.0])
"""From the frame of a `.ply`, y down, to that of tiles."""


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    up: gltf.Up | None = None,
    to_earth: Float | None = None,
) -> int:
    """Write `gaussians` as a tileset beside `path`, a `tileset.json`; returns how many the finest tiles hold.

    The surroundings of the scene (`lod.levels.surroundings`) are left out: around a place on the earth is the earth. So
    are rows with a non-finite parameter and rows with an opacity under MIN_OPACITY.

    offset: of `Contents`. antialiased: a flag of each `.spz`.
    to_earth: matrix [4, 4] from metres to the east, to the north and upwards of the model's origin to metres from the
    earth's centre, for a model with x to the east, y down and z to the north. None: the tileset has the coordinates of
    the model, turned so that z is up.
    up: of a model without `to_earth`, as of `gltf.node`.

    An index that is there is removed first and the new one is written last. Tiles of an earlier one that the new one
    does not name stay. Raises OSError.
    """
    levels = make_levels(visible(gaussians))
    write_levels(path, levels, offset=offset, antialiased=antialiased, up=up, to_earth=to_earth)
    return levels.levels[0].gaussians.count


def write_levels(
    path: Path,
    levels: Levels,
    *,
    offset: Offset = NO_OFFSET,
    antialiased: bool = False,
    up: gltf.Up | None = None,
    to_earth: Float | None = None,
    most: int = MOST,
) -> None:
    """Write levels as `write` does. most: Gaussians of a tile at most, unless a leaf has more."""
    tiles = _Tiles(levels, leaf_boxes(levels.levels), path.parent, antialiased, most)
    path.unlink(missing_ok=True)
    (path.parent / FOLDER).mkdir(parents=True, exist_ok=True)
    root = tiles.write(levels.tree, len(levels.levels) - 1)
    moved = np.eye(4)
    moved[:3, 3] = TURN @ offset
    moved = (_upright(up) if to_earth is None else to_earth) @ moved
    document = {
        "asset": {"version": "1.1", "generator": "Splatmill"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {
            "3DTILES_content_gltf": {"extensionsUsed": EXTENSIONS, "extensionsRequired": EXTENSIONS}
        },
        "geometricError": PIXELS * float(np.linalg.norm(root["boundingVolume"]["box"][3:])),
        "root": {"transform": moved.T.flatten().tolist(), "refine": "REPLACE", **root},
    }
    atomic_write(path, json.dumps(document, separators=(",", ":"), allow_nan=False), sync=True)


def files(path: Path) -> list[Path]:
    """The files of a tileset that `write` has written: `path`, and its tiles."""
    paths, tiles = [path], [json.loads(path.read_bytes())["root"]]
    while tiles:
        tile = tiles.pop()
        tiles += tile.get("children", [])
        if "content" in tile:
            paths.append(path.parent / tile["content"]["uri"])
    return paths


@dataclass
class _Tiles:
    """Writes the tiles of a scene.

    boxes: of its leaves (`leaf_boxes`). folder: of the index. most: Gaussians of a tile.
    written: how many tiles there are.
    """

    levels: Levels
    boxes: Tensor
    folder: Path
    antialiased: bool
    most: int
    written: int = 0

    def write(self, node: Node, level: int) -> dict[str, Any]:
        """Write the tile of a node in a level, and those of the finer levels below it; returns what the index says."""
        errors = self.levels.levels[level].errors[node.first : node.last]
        tile: dict[str, Any] = {
            "boundingVolume": {"box": self._box(node)},
            "geometricError": PIXELS * max(errors, default=0.0),
        }
        rows = self._rows(node, level)
        if len(rows):
            name = f"{FOLDER}/{self.written}.glb"
            self.written += 1
            _write_tile(
                self.folder / name,
                self.levels.levels[level].gaussians.select(rows),
                antialiased=self.antialiased,
            )
            tile["content"] = {"uri": name}
        if level:
            tile["children"] = [self.write(part, level - 1) for part in self._parts(node, level - 1)]
        return tile

    def _parts(self, node: Node, level: int) -> list[Node]:
        """The nodes below `node`, or itself, that have few enough Gaussians in a level for a tile each."""
        if node.children is None or len(self._rows(node, level)) <= self.most:
            return [node]
        return [part for child in node.children for part in self._parts(child, level)]

    def _rows(self, node: Node, level: int) -> Tensor:
        """The rows of a node in a level, which lie one after the other."""
        runs = self.levels.levels[level].runs
        last = runs[node.last - 1]
        return torch.arange(runs[node.first].first, last.first + last.count)

    def _box(self, node: Node) -> list[float]:
        """The box of a node in the frame of the tiles: its centre, and half of each side as a vector."""
        low = self.boxes[0, node.first : node.last].amin(0).numpy()
        high = self.boxes[1, node.first : node.last].amax(0).numpy()
        sides = TURN @ np.diag(np.maximum(high - low, THINNEST) / 2)
        return [*(TURN @ ((low + high) / 2)).tolist(), *sides.T.flatten().tolist()]


def _upright(up: gltf.Up | None) -> Float:
    """The matrix [4, 4] that turns tiles so that `up`, in the frame of a `.ply`, is their z axis."""
    rotation = gltf.node(up).get("rotation")
    matrix = np.eye(4)
    if rotation is not None:
        vector, w = np.array(rotation[:3]), rotation[3]
        cross = np.cross(np.eye(3), vector)  # by rows; v x is the matrix itself, as it is antisymmetric
        turn = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
        matrix[:3, :3] = FROM_GLTF @ turn @ FROM_GLTF.T
    return matrix


def _write_tile(path: Path, gaussians: Gaussians, *, antialiased: bool) -> None:
    """Write a `.glb` whose attributes are those of the `.spz` in it: none of them has an array of its own.

    Its node has no rotation, which CesiumJS 1.145 does not apply to Gaussians.
    """
    parts = gltf.Parts()
    view = parts.add_file(spz.encoded(gaussians, antialiased=antialiased))
    means = gaussians.means * torch.tensor([1.0, -1.0, -1.0])  # the frame of glTF
    bounds = {"min": means.amin(0).tolist(), "max": means.amax(0).tolist()}
    names = {"POSITION": "VEC3", "COLOR_0": "VEC4"}
    names |= {f"{glb.EXTENSION}:ROTATION": "VEC4", f"{glb.EXTENSION}:SCALE": "VEC3"}
    names |= {
        f"{glb.EXTENSION}:SH_DEGREE_{degree}_COEF_{order}": "VEC3"
        for degree, order in glb.harmonics(gaussians.degree)
        if degree
    }
    for name, kind in names.items():
        accessor: dict[str, Any] = {"componentType": 5126, "count": gaussians.count, "type": kind}
        if name == "COLOR_0":
            accessor |= {"componentType": 5121, "normalized": True}
        parts.accessors.append(accessor | (bounds if name == "POSITION" else {}))
    extension = glb.DRAWN | {"extensions": {COMPRESSED: {"bufferView": view}}}
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(names)},
        "extensions": {glb.EXTENSION: extension},
    }
    document = {
        "asset": gltf.ASSET,
        "extensionsUsed": EXTENSIONS,
        "extensionsRequired": EXTENSIONS,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        **parts.document(),
    }
    gltf.write(path, document, parts, f"{gaussians.count} Gaussians")
