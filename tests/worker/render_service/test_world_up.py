"""Proves that up follows from the cameras of a model, and that a `.glb` of it and of its mesh then stands upright.

What programs of others make of the rotation of a node is theirs; glTF asks for it.
"""

from pathlib import Path

import numpy as np
import pytest

from splatmill.schema import CameraSpec, ModelCamera, ModelCameras, OrbitRequest
from splatmill_worker.mesh import glb as mesh_glb
from splatmill_worker.mesh.triangles import Mesh
from splatmill_worker.render_service.convert import convert
from splatmill_worker.render_service.world_up import up_beside, up_of
from splatmill_worker.splat.formats import ply, registry
from splatmill_worker.splat.orbit import orbit_cameras
from tests.support.files.turned import shown
from tests.support.gaussians import some_gaussians
from tests.worker.mesh.test_triangles import chunks

Z_UP = np.eye(3)
Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From a world with z up to others."""
TILTED = np.linalg.qr(np.array([[1.0, 0.9, 0.2], [-0.7, 1, 0.8], [0.5, -0.9, 1]]))[0]
X_UP = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def cameras(turn: np.ndarray, count: int = 12) -> ModelCameras:
    """Of photos around an object that stands upright in a world with z up, in a world that is turned."""
    rows = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        eye = turn @ np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), 1.5 + 0.5 * np.sin(3 * angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, turn @ np.array([0.0, 0, 1]))
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
        spec = CameraSpec.model_validate(
            {"camera_to_world": matrix.tolist(), "width": 40, "height": 32, "fov_y_deg": 50.0}
        )
        rows.append(ModelCamera(name=f"{k}.jpg", split="train", camera=spec))
    return ModelCameras(cameras=rows)


@pytest.mark.parametrize("turn", [Z_UP, Y_DOWN, X_UP, TILTED], ids=["z up", "y down", "x up", "tilted"])
def test_what_stands_above_is_shown_above(turn: np.ndarray, tmp_path: Path) -> None:
    if np.linalg.det(turn) < 0:
        turn = -turn
    top = turn @ np.array([0.0, 0, 1])
    document = cameras(turn)
    up = up_of(document)
    assert up is not None
    np.testing.assert_allclose(up, top, atol=1e-9 if turn is not TILTED else 0.02)
    (tmp_path / "cameras.json").write_text(document.model_dump_json(exclude_none=True))
    scene = some_gaussians(50, 1)
    scene.means[:] *= 0.1
    scene.means[0] = 5.0 * scene.means.new_tensor(top)
    model = tmp_path / "model.ply"
    ply.write(model, scene)
    assert up_beside(model) == up

    convert(model, [tmp_path / "model.glb"], None)
    content, data = chunks((tmp_path / "model.glb").read_bytes())
    # Attributes begin with POSITION, whose first row is the one on top: rows are not reordered.
    first = np.frombuffer(data, "<f4", 3)
    np.testing.assert_allclose(shown(content, first), [0, 5, 0], atol=0.1)
    back = registry.read(tmp_path / "model.glb").gaussians
    np.testing.assert_array_equal(back.means.numpy(), scene.means.numpy())

    vertices = np.array([3.0 * top, [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]], np.float32)
    mesh_glb.write(tmp_path / "mesh.glb", Mesh(vertices, np.array([[0, 1, 2]])), (0.0, 0.0, 0.0), up)
    content, data = chunks((tmp_path / "mesh.glb").read_bytes())
    np.testing.assert_allclose(shown(content, np.frombuffer(data, "<f4", 3)), [0, 3, 0], atol=0.1)


def test_a_model_with_y_down_has_no_rotation(tmp_path: Path) -> None:
    for name, up in (("known", (0.0, -1.0, 0.0)), ("unknown", None)):
        registry.write(tmp_path / f"{name}.glb", some_gaussians(5, 0), up=up)
    assert (tmp_path / "known.glb").read_bytes() == (tmp_path / "unknown.glb").read_bytes()
    registry.write(tmp_path / "head.glb", some_gaussians(5, 0), up=(0.0, 1.0, 0.0))
    content, _ = chunks((tmp_path / "head.glb").read_bytes())
    np.testing.assert_allclose(shown(content, [1, -1, 0]), [1, 1, 0], atol=1e-12)


def test_few_cameras_tell_nothing(tmp_path: Path) -> None:
    assert up_of(cameras(Z_UP, 2)) is None
    assert up_of(None) is None
    assert up_beside(tmp_path / "model.ply") is None
    (tmp_path / "cameras.json").write_text("[]")
    assert up_beside(tmp_path / "model.ply") is None


def test_recovered_cameras_say_what_is_up_however_the_photos_were_held(tmp_path: Path) -> None:
    # A flight that looks straight down: what is up in its photos is where it flies.
    flight = cameras(Z_UP)
    for number, row in enumerate(flight.cameras):
        matrix = [[1, 0, 0, 0], [0, 0, 1, -9], [0, -1, 0, 8.0 * number], [0, 0, 0, 1]]
        row.camera = row.camera.model_copy(update={"camera_to_world": matrix})
    flight = flight.model_copy(update={"up": (0.0, -1.0, 0.0)})
    assert up_of(flight) == (0.0, -1.0, 0.0)
    (camera, *_) = orbit_cameras(
        flight, some_gaussians(50, 0), OrbitRequest(seconds=0.5, fps=8, width=64, height=48)
    )
    assert camera.viewmat[1, 1] > 0.9, "what is lower in the world is lower in the picture"
    assert camera.center[1] == pytest.approx(-9, abs=0.1), "the camera is as high as the flight"
