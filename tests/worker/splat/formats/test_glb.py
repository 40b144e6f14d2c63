"""Proves that a `.glb` has the structure that glTF 2.0 and KHR_gaussian_splatting ask for, and is read back exactly.

Does not prove that a foreign reader shows it: splat-transform writes the format and does not read it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatmill_worker.errors import ModelUnreadable
from splatmill_worker.splat.formats import glb, registry
from splatmill_worker.splat.gaussians import SH_C0
from tests.support.gaussians import differences, some_gaussians

EXTENSION = "KHR_gaussian_splatting"


def _parsed(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert length % 4 == 0
    behind = struct.unpack_from("<I4s", data, 20 + length)
    assert behind == (len(data) - 28 - length, b"BIN\0")
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def _values(document: dict[str, Any], binary: bytes, name: str) -> np.ndarray[Any, Any]:
    (primitive,) = document["meshes"][0]["primitives"]
    accessor = document["accessors"][primitive["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    assert view["byteOffset"] % 4 == 0
    assert view["byteLength"] == accessor["count"] * width * np.dtype(kind).itemsize
    part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(part, kind).reshape(accessor["count"], width)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_file_has_the_attributes_that_the_extension_asks_for(tmp_path: Path, degree: int) -> None:
    scene = some_gaussians(50, degree)
    assert glb.write(tmp_path / "m.glb", scene) == 50
    document, binary = _parsed((tmp_path / "m.glb").read_bytes())
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == [EXTENSION]
    assert document["buffers"] == [{"byteLength": len(binary)}]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"
    harmonics = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    others = [f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")]
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *others, *harmonics}
    position = _values(document, binary, "POSITION")
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    assert accessor["min"] == position.min(0).tolist()
    assert accessor["max"] == position.max(0).tolist()
    # glTF's y is up: the .ply's is down.
    assert np.array_equal(position, scene.means.numpy() * np.array([1, -1, -1], np.float32))
    rotation = _values(document, binary, f"{EXTENSION}:ROTATION")
    assert np.allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    scale = _values(document, binary, f"{EXTENSION}:SCALE")
    assert np.allclose(scale, np.exp(scene.log_scales.numpy()), rtol=1e-6)
    opacity = _values(document, binary, f"{EXTENSION}:OPACITY")[:, 0]
    assert np.allclose(opacity, torch.sigmoid(scene.logit_opacities).numpy(), atol=1e-6)
    color = _values(document, binary, "COLOR_0")
    assert document["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True
    shown = np.clip(0.5 + SH_C0 * scene.sh[:, 0].numpy(), 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    assert np.abs(color[:, :3] / 255 - linear).max() <= 0.5 / 255 + 1e-6


def test_a_scene_is_read_back_as_it_was(tmp_path: Path) -> None:
    scene = some_gaussians(300, 3)
    glb.write(tmp_path / "m.glb", scene, offset=(450_000.0, -7.0, 0.0), antialiased=True)
    contents = registry.read(tmp_path / "m.glb")
    assert contents.offset == (450_000.0, -7.0, 0.0)
    assert contents.antialiased is True
    assert max(differences(contents.gaussians, scene).values()) < 1e-5


def test_harmonics_of_degree_4_are_left_out_and_said(tmp_path: Path) -> None:
    scene = some_gaussians(30, 3)
    glb.write(tmp_path / "m.glb", scene)
    assert glb.read(tmp_path / "m.glb").notes == ()

    def add(document: dict[str, Any]) -> None:
        attributes = _primitive(document)["attributes"]
        attributes |= {f"{EXTENSION}:SH_DEGREE_4_COEF_{n}": attributes["POSITION"] for n in range(9)}

    (tmp_path / "four.glb").write_bytes(_changed((tmp_path / "m.glb").read_bytes(), add))
    contents = glb.read(tmp_path / "four.glb")
    assert max(differences(contents.gaussians, scene).values()) < 1e-5
    assert contents.notes == ("Its harmonics of degree 4 are read to degree 3.",)


def test_nothing_is_a_model_too(tmp_path: Path) -> None:
    assert glb.write(tmp_path / "m.glb", some_gaussians(3, 1).select(torch.arange(0))) == 0
    with pytest.raises(ModelUnreadable, match="0 primitives"):
        glb.read(tmp_path / "m.glb")


def _changed(data: bytes, change: Callable[[dict[str, Any]], Any]) -> bytes:
    document, binary = _parsed(data)
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return (
        head
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def _primitive(document: dict[str, Any]) -> dict[str, Any]:
    primitive: dict[str, Any] = document["meshes"][0]["primitives"][0]
    return primitive


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d["accessors"][0].update(count=10**9), "more than 400 times"),
        (lambda d: [a.update(count=31) for a in d["accessors"]], "outside of its binary data"),
        (lambda d: [a.update(count="3" * 99) for a in d["accessors"]], "POSITION has '333"),
        (lambda d: d["accessors"][0].update(count=-1), "outside of its binary data|has 30 values"),
        (lambda d: d["bufferViews"][2].update(byteOffset=-4), "outside of its binary data"),
        (lambda d: d["accessors"][4].update(count=20), "has 20 values, and POSITION 30"),
        (
            lambda d: (d["accessors"][0].update(count=1), d["bufferViews"][0].update(byteStride=10**30)),
            "could not be read",
        ),
        (lambda d: _primitive(d).update(extras={"offset": [10**400, 0, 0]}), "too large"),
        (lambda d: _primitive(d).update(mode=4), "mode 4"),
        (lambda d: _primitive(d)["extensions"][EXTENSION].update(kernel="box"), "kernel is 'box'"),
        (lambda d: _primitive(d)["extensions"][EXTENSION].update(colorSpace="linear"), "'linear'"),
        (lambda d: _primitive(d)["attributes"].pop(f"{EXTENSION}:OPACITY"), "OPACITY.* is missing"),
        (lambda d: _primitive(d)["attributes"].pop(f"{EXTENSION}:SH_DEGREE_1_COEF_2"), "is missing"),
        (lambda d: d["nodes"][0].update(scale=[2, 2, 2]), "moves, turns or scales"),
        (lambda d: d.update(meshes=[]), "0 primitives"),
        (
            lambda d: _primitive(d)["attributes"].update({f"{EXTENSION}:SCALE": 0}),
            "negative scales, as drafts",
        ),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], says: str
) -> None:
    path = tmp_path / "m.glb"
    glb.write(path, some_gaussians(30, 1))
    path.write_bytes(_changed(path.read_bytes(), change))
    with pytest.raises(ModelUnreadable, match=says):
        glb.read(path)


def test_damaged_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "m.glb"
    glb.write(path, some_gaussians(30, 1))
    data = path.read_bytes()
    text = b"[" * 10**5
    nested = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text
    for broken in (
        data[:-8],
        data[:15],
        b"",
        b"not glTF" + data[8:],
        data.replace(b"BIN\0", b"BON\0"),
        nested,
    ):
        path.write_bytes(broken)
        with pytest.raises(ModelUnreadable, match=r"m\.glb"):
            glb.read(path)
