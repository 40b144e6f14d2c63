"""`mesh-file`: meshes of a model file with the cameras beside it, with others, and with none; and its refusals.

What a mesh is like is proved in tests/worker/mesh.
"""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatmill.schema import ModelCameras, OrbitRequest
from splatmill_worker.mesh import ply
from splatmill_worker.render_service import mesh as program
from splatmill_worker.render_service.mesh import cameras_for, main
from splatmill_worker.splat.formats import ply as model_ply
from tests.worker.mesh.test_build import ball, cameras
from tests.worker.mesh.test_triangles import chunks


def chosen(model: Path, out: Path, **options: Any) -> Namespace:
    plain = {
        "faces": 5000,
        "voxel": None,
        "box": None,
        "texture": None,
        "cameras": None,
        "up": "z",
        "backend": None,
        "parent": None,
    }
    return Namespace(model=model, out=out, **{**plain, **options})


@pytest.fixture
def model(tmp_path: Path) -> Path:
    model_ply.write(tmp_path / "model.ply", ball(), offset=(500.0, 0.0, -20.0))
    return tmp_path / "model.ply"


def document() -> str:
    """A cameras.json of the cameras around the ball."""
    rows = []
    for index, camera in enumerate(cameras()):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.viewmat[:3, :3].T, camera.center
        shape = {"width": 96, "height": 96, "fx": 140.0, "fy": 140.0, "cx": 48.0, "cy": 48.0}
        rows.append(
            {
                "name": f"{index}.jpg",
                "split": "train",
                "camera": {"camera_to_world": matrix.tolist(), **shape},
            }
        )
    return json.dumps({"cameras": rows})


def test_the_cameras_beside_the_model_are_used(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model.with_name("cameras.json").write_text(document())
    out = model.with_name("mesh.glb")
    assert main(chosen(model, out)) == 0
    assert "from 12 views" in capsys.readouterr().out
    content, _ = chunks(out.read_bytes())
    assert content["meshes"][0]["primitives"][0]["extras"] == {"offset": [500.0, 0.0, -20.0]}
    assert "textures" not in content


def test_a_texture_stands_in_place_of_colours(model: Path) -> None:
    model.with_name("cameras.json").write_text(document())
    out = model.with_name("mesh.glb")
    assert main(chosen(model, out, texture=256)) == 0
    content, _ = chunks(out.read_bytes())
    assert set(content["meshes"][0]["primitives"][0]["attributes"]) == {"POSITION", "TEXCOORD_0"}
    assert len(content["textures"]) == 1


def test_without_cameras_the_model_is_seen_from_rings(
    model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(program, "RING", OrbitRequest(seconds=0.5, fps=20, width=96, height=96))
    out = model.with_name("mesh.ply")
    assert main(chosen(model, out)) == 0
    assert "from 30 views" in capsys.readouterr().out
    vertices, faces, colors = ply.read(out)
    assert len(faces) > 2000
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1.0).max() < 0.1
    assert colors is not None
    assert b"comment offset 500 0 -20" in out.read_bytes()


def test_rings_stand_around_the_model_above_and_below_it() -> None:
    every = cameras_for(None, ball((5.0, 0.0, 0.0)), np.array([0.0, 0.0, 1.0]))
    assert len(every) == 72
    centers = np.array([camera.center for camera in every])
    assert np.abs(centers.mean(axis=0)[:2] - [5.0, 0.0]).max() < 0.2
    assert {round(z, 2) for z in centers[:, 2]} == {round(z, 2) for z in centers[::24, 2]}
    assert centers[:, 2].min() < 0 < centers[:, 2].max()
    assert len(cameras_for(ModelCameras.model_validate_json(document()), ball())) == 12


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"voxel": 1e-5}, "Choose larger voxels or a smaller box"),
        ({"box": '{"min": [5, 5, 5], "max": [6, 6, 6]}'}, "No two cameras agree on a surface"),
        ({"cameras": "model.ply"}, "is not the cameras.json of a model"),
        ({"cameras": "absent.json"}, "absent.json: No such file"),
    ],
)
def test_what_cannot_be_made_is_said_and_leaves_nothing(
    model: Path, options: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model.with_name("cameras.json").write_text(document())
    if "cameras" in options:
        options = {"cameras": model.with_name(options["cameras"])}
    out = model.with_name("mesh.ply")
    assert main(chosen(model, out, **options)) != 0
    assert said in capsys.readouterr().err
    assert not out.exists()
