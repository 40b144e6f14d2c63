"""Meshes as `.glb`: one primitive of triangles, with a texture or a colour at each vertex, which programs show unlit.

The light of the photos is in the colours already, hence KHR_materials_unlit. glTF has y up: the mesh is turned about x
by 180 degrees, as the `.glb` of its model is, and its node further where -y is not up in the world of the cameras.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.splat.formats import gltf

UNLIT = "KHR_materials_unlit"
_TRIANGLES = 4

_LINEAR, _LINEAR_OF_LEVELS, _CLAMPED = 9729, 9987, 33071

QUALITY = 92
"""JPEG quality of a texture."""


def write(path: Path, mesh: Mesh, offset: tuple[float, float, float], up: gltf.Up | None = None) -> None:
    """Write a mesh.

    offset: world = mesh + offset, in the `extras` of the primitive where it is not 0.
    up: of the mesh, as of `gltf.node`.
    """
    parts = gltf.Parts()
    attributes = {"POSITION": parts.add(mesh.vertices * np.array([1, -1, -1], np.float32), bounds=True)}
    if mesh.colors is not None:
        light = gltf.linear(mesh.colors / 255.0)
        opaque = np.concatenate([light, np.ones((len(light), 1))], 1)
        attributes["COLOR_0"] = parts.add((opaque * 65535).round().astype(np.uint16), normalized=True)
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    pictures: dict[str, Any] = {}
    if mesh.uvs is not None and mesh.texture is not None:
        attributes["TEXCOORD_0"] = parts.add(mesh.uvs)
        surface["baseColorTexture"] = {"index": 0}
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_OF_LEVELS, "wrapS": _CLAMPED, "wrapT": _CLAMPED}
        pictures = {
            "images": [{"bufferView": parts.add_file(_jpeg(mesh.texture)), "mimeType": "image/jpeg"}],
            "samplers": [sampler],
            "textures": [{"sampler": 0, "source": 0}],
        }
    primitive: dict[str, Any] = {
        "mode": _TRIANGLES,
        "attributes": attributes,
        "indices": parts.add(mesh.faces.reshape(-1, 1).astype(np.uint32), indices=True),
        "material": 0,
    }
    if any(offset):
        primitive["extras"] = {"offset": offset}
    document = {
        "asset": gltf.ASSET,
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [gltf.node(up)],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}}],
    }
    gltf.write(path, document | pictures | parts.document(), parts, f"{len(mesh.faces)} triangles")


def _jpeg(pixels: npt.NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return file.getvalue()
