"""Meshes that are kept, from a real server with a real renderer, Redis and storage: what they report, store, cancel
and refuse; the process that makes them; and the SDK and the command line with them.

Not proved here: what a mesh is like (tests/worker/mesh), and how many may wait, which test_orbits.py proves for both.
"""

from __future__ import annotations

import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.errors import InvalidRequest, NotFound, WaitTimeout
from splatmill.schema import CameraSpec, ModelCamera, ModelCameras, Progress
from splatmill.sdk.client import Client
from splatmill_server.background import kept, meshes
from splatmill_worker.mesh import ply
from tests.support.ball import PROPERTIES, write_ply
from tests.support.command_line import invoke, spawn
from tests.support.served_app import Serve, ServedApp, problem, stored
from tests.support.servers.rendering import KeptFiles, renderer_in, serve_in, store_only_ball
from tests.support.waiting import wait_for
from tests.worker.mesh.test_triangles import chunks, values

pytestmark = pytest.mark.slow

MODEL = "b" * 16
WISH = {"faces": 2000, "voxel": 0.1}
KEPT = KeptFiles("meshes", MODEL, WISH)
MESHES = KEPT.path


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "_PAUSE_SECONDS", 0.02)
    monkeypatch.setattr(kept, "_LOOK_SECONDS", 0.2)
    monkeypatch.setattr(meshes, "_WRITE_SECONDS", 0.0)


@pytest.fixture
def app(serve: Serve, folder: Path, renderer: subprocess.Popen[bytes]) -> ServedApp:
    running = serve_in(serve, folder)
    store_only_ball(running, folder, MODEL, count=1500)
    running.service.storage.put(layout.model_file(MODEL, "cameras.json"), around())
    return running


def around() -> bytes:
    """The cameras.json of twelve small views of the ball."""
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    eyes = [(4 * np.cos(t), 1.5 * np.cos(3 * t), 4 * np.sin(t)) for t in turns]
    views = [
        CameraSpec.looking_at(eye, (0, 0, 0), width=96, height=96, fov_y_deg=40, up=(0, 1, 0)) for eye in eyes
    ]
    rows = [
        ModelCamera(name=f"{number}.jpg", split="train", camera=view) for number, view in enumerate(views)
    ]
    return ModelCameras(cameras=rows).model_dump_json().encode()


def makers(renderer: subprocess.Popen[bytes]) -> list[psutil.Process]:
    """The processes of the renderer that make meshes."""
    processes = []
    for each in psutil.Process(renderer.pid).children():
        with suppress(psutil.Error):  # it has ended
            if "mesh-file" in each.cmdline():
                processes.append(each)
    return processes


def caught(renderer: subprocess.Popen[bytes]) -> psutil.Process:
    """The process that makes a mesh, suspended so that it cannot end by itself."""

    def suspended() -> psutil.Process | None:
        for each in makers(renderer):
            with suppress(psutil.Error, ProcessLookupError):
                each.suspend()
                return each
        return None

    return wait_for(suspended)


def left(folder: Path) -> list[Path]:
    """What the renderer has in its temporary folder."""
    return [path for path in (folder / "tmp").iterdir() if path.name.startswith("splatmill-")]


def test_a_mesh_is_made_in_the_background_kept_and_found_again(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[Progress] = []
    write = app.service.meshes._write

    def heard(name: str, record: Any) -> None:
        if record.progress is not None:
            said.append(record.progress)
        write(name, record)

    monkeypatch.setattr(app.service.meshes, "_write", heard)
    made = KEPT.begun(app, texture=256)
    assert (made["state"], made["request"]["faces"], made.get("facts")) == ("queued", 2000, None)
    done = KEPT.ended(app, made["id"])
    assert done["state"] == "succeeded", done
    assert [p.stage for p in said][-1] == "painting a texture"
    assert (12, 12) in {(p.done, p.total) for p in said if p.stage == "rendering depths"}
    assert done.get("progress") is None
    assert KEPT.files(app) == [f"{made['id']}/mesh", f"{made['id']}/mesh.json"]
    file = app.http.get(done["links"]["file"])
    assert (file.status_code, file.headers["content-type"]) == (200, "model/gltf-binary")
    assert len(file.content) == done["bytes"]
    document, data = chunks(file.content)
    assert [image["mimeType"] for image in document["images"]] == ["image/jpeg"]
    positions = values(document, data, 0, "<f4")
    triangles = document["accessors"][document["meshes"][0]["primitives"][0]["indices"]]["count"] // 3
    assert 1000 < triangles == done["facts"]["triangles"] <= 2000
    assert len(positions) == done["facts"]["vertices"]
    assert done["facts"]["views"] == 12
    assert abs(np.median(np.linalg.norm(positions, axis=1)) - 1) < 0.1
    part = app.http.get(done["links"]["file"], headers={"Range": "bytes=0-3"})
    assert (part.status_code, part.content) == (206, b"glTF")
    head = app.http.head(done["links"]["file"])
    assert (head.headers["content-length"], head.content) == (str(done["bytes"]), b"")

    again = app.http.post(MESHES, json=WISH | {"texture": 256, "format": "glb"})  # the default
    assert (again.status_code, again.json()) == (200, done)
    cut = KEPT.begun(app, format="ply", box={"min": [-2, -2, 0], "max": [1e9, 2, 2]})
    assert KEPT.ended(app, cut["id"])["state"] == "succeeded"
    assert [mesh["id"] for mesh in app.http.get(MESHES).json()["meshes"]] == [cut["id"], made["id"]]
    app.service.usage.scan()
    listed = app.http.get("/v1/storage").json()["largest"]
    held = sum(entry.size for entry in app.service.storage.entries(layout.model(MODEL)))
    assert [entry["bytes"] for entry in listed if entry["id"] == MODEL] == [held]
    assert app.http.delete(f"{MESHES}/{cut['id']}").status_code == 204
    assert [mesh["id"] for mesh in app.http.get(MESHES).json()["meshes"]] == [made["id"]]
    problem(app.http.get(cut["links"]["file"]), 404, "mesh_not_found")


def test_a_mesh_that_is_deleted_ends_its_process_and_leaves_nothing(
    app: ServedApp, renderer: subprocess.Popen[bytes], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = KEPT.begun(app)
    caught(renderer)
    problem(app.http.get(made["links"]["file"]), 409, "mesh_not_ready")
    monkeypatch.setattr(meshes.Meshes, "most_unfinished", 1)
    problem(app.http.post(MESHES, json=WISH | {"faces": 500}), 409, "too_many_meshes")
    assert app.http.delete(made["links"]["self"]).status_code == 204
    wait_for(lambda: not makers(renderer), 20)
    wait_for(lambda: not app.service.meshes.unfinished.running)
    wait_for(lambda: not left(folder))
    assert (KEPT.files(app), KEPT.marks(app), app.redis.keys(keys.lease("*", "*"))) == ([], [], [])
    problem(app.http.delete(made["links"]["self"]), 404, "mesh_not_found")
    assert KEPT.ended(app, KEPT.begun(app)["id"])["state"] == "succeeded"


def test_the_mesh_of_a_deleted_model_leaves_nothing(
    app: ServedApp, renderer: subprocess.Popen[bytes], folder: Path
) -> None:
    KEPT.begun(app)
    caught(renderer)
    app.service.storage.delete_prefix(layout.model(MODEL))
    wait_for(lambda: not makers(renderer), 20)
    wait_for(lambda: KEPT.marks(app) == [])
    assert not [path for path in stored(app) if path.startswith(layout.model(MODEL))]
    wait_for(lambda: not left(folder))


def test_a_process_that_is_killed_is_a_problem_and_views_are_rendered_meanwhile(
    app: ServedApp, renderer: subprocess.Popen[bytes]
) -> None:
    made = KEPT.begun(app)
    process = caught(renderer)
    view = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=48, height=32).model_dump(mode="json")
    assert app.http.post(f"/v1/models/{MODEL}/render", json={"camera": view}).status_code == 200
    process.kill()
    failed = KEPT.ended(app, made["id"])
    assert (failed["state"], failed["problem"]["code"]) == ("failed", "out_of_memory")
    assert "smaller box" in failed["problem"]["advice"]
    again = app.http.post(MESHES, json=WISH)
    assert (again.status_code, again.json()["id"], again.json()["state"]) == (202, made["id"], "queued")
    assert KEPT.ended(app, made["id"])["state"] == "succeeded"


def test_the_process_of_a_renderer_that_is_killed_ends_with_it_and_the_mesh_is_begun_again(
    app: ServedApp, serve: Serve, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "storage").symlink_to(folder / "storage")
    address = tmp_path / "r.sock"
    other = serve(renderer_url=f"unix:{address}", storage=str(folder / "storage"))
    monkeypatch.setattr(app.service.meshes.unfinished, "_take_up", _nothing)
    with renderer_in(tmp_path) as mine:
        made = KEPT.begun(other)
        process = caught(mine)
        mine.kill()
        with suppress(psutil.Error):  # caught before it asked to end with its parent, it ends as it does
            process.resume()
        wait_for(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE)
        assert other.http.get(made["links"]["self"]).json()["state"] != "failed"
        address.unlink()
        address.symlink_to(folder / "r.sock")
        assert KEPT.ended(other, made["id"])["state"] == "succeeded"


async def _nothing() -> None:
    pass


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({"faces": 3}, "invalid_request"),
        ({"faces": 10**9}, "invalid_request"),
        ({"voxel": 0}, "invalid_request"),
        ({"voxel": "nan"}, "invalid_request"),
        ({"format": "obj"}, "invalid_request"),
        ({"box": {"min": [0, 0, 0], "max": [0, 1, 1]}}, "invalid_request"),
        ({"texture": 100}, "invalid_request"),
        ({"texture": 512, "format": "ply"}, "invalid_request"),
        ({"gloss": True}, "invalid_request"),
    ],
)
def test_what_is_no_request_is_refused_at_once(app: ServedApp, changed: dict[str, Any], code: str) -> None:
    problem(app.http.post(MESHES, json=WISH | changed), 422, code)
    assert KEPT.marks(app) == []


def test_what_cannot_be_made_fails_with_the_reason(app: ServedApp, folder: Path) -> None:
    for changed, said in (
        ({"voxel": 1e-9}, "Choose larger voxels"),
        ({"box": {"min": [5, 5, 5], "max": [6, 6, 6]}}, "agree on a surface"),
    ):
        failed = KEPT.ended(app, KEPT.begun(app, **changed)["id"])
        assert (failed["state"], failed["problem"]["code"]) == ("failed", "option_out_of_range")
        assert said in failed["problem"]["detail"]
    storage = app.service.storage
    storage.put(layout.model_file(MODEL, "model.ply"), b"no model")
    assert KEPT.ended(app, KEPT.begun(app)["id"])["problem"]["code"] == "model_corrupt"
    # One Gaussian, which is a small ball, and one that nobody can see.
    write_ply(folder / "model.ply", 1)
    one = (folder / "model.ply").read_bytes()
    storage.put(layout.model_file(MODEL, "model.ply"), one)
    assert KEPT.ended(app, KEPT.begun(app)["id"])["facts"]["triangles"] <= 2000
    opacity = 4 * PROPERTIES.index("opacity")
    end = one.index(b"end_header\n") + len(b"end_header\n") + opacity
    faint = one[:end] + np.float32(-9).tobytes() + one[end + 4 :]
    storage.put(layout.model_file(MODEL, "model.ply"), faint)
    assert "agree on a surface" in KEPT.ended(app, KEPT.begun(app)["id"])["problem"]["detail"]


def test_the_sdk_waits_with_progress_and_makes_nothing_twice(
    app: ServedApp, renderer: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    heard: list[Progress] = []
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        path = model.mesh(tmp_path / "ball.ply", on_progress=heard.append, faces=1000, voxel=0.1)
        vertices, faces, colors = ply.read(path)
        assert 500 < len(faces) <= 1000
        assert colors is not None
        assert heard[-1].stage == "succeeded"
        (whole,) = model.meshes.list()
        assert (whole.request.format, whole.facts is not None) == ("ply", True)
        renderer.send_signal(signal.SIGSTOP)  # what is stored needs no renderer
        try:
            assert model.mesh(tmp_path / "again.ply", faces=1000, voxel=0.1).read_bytes() == path.read_bytes()
            with pytest.raises(WaitTimeout, match="mesh"):
                model.mesh(tmp_path, timeout=0.2, faces=1001)
        finally:
            renderer.send_signal(signal.SIGCONT)
        for begun_mesh in model.meshes.list():
            model.meshes.delete(begun_mesh.id)
        with pytest.raises(NotFound):
            model.meshes.get(whole.id)
        with pytest.raises(InvalidRequest):
            model.mesh(tmp_path, faces=1)
    assert abs(np.median(np.linalg.norm(vertices, axis=1)) - 1) < 0.1


def test_the_command_shows_what_is_done_and_an_interrupt_cancels_the_mesh(
    app: ServedApp, renderer: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    server = ("--server", str(app.http.base_url))
    done = invoke("mesh", MODEL, "-o", tmp_path / "m.glb", "--faces", "1500", "--voxel", "0.1", *server)
    assert done.exit_code == 0, done.output
    assert "triangles" in done.output
    assert (tmp_path / "m.glb").read_bytes()[:4] == b"glTF"
    command = spawn("mesh", MODEL, "-o", tmp_path / "never.glb", *server)
    caught(renderer)
    assert command.stdout is not None
    assert command.stdout.readline()  # it has heard of its mesh
    command.send_signal(signal.SIGINT)
    assert command.wait(20) == 130
    command.communicate()
    wait_for(lambda: not makers(renderer), 20)
    wait_for(lambda: not app.service.meshes.unfinished.running)
    assert KEPT.marks(app) == []
    assert not (tmp_path / "never.glb").exists()
    refused = invoke("mesh", MODEL, "--up", "z", *server)
    assert "is for a model file" in " ".join(refused.output.replace("│", " ").split())


def test_meshes_of_no_model_and_without_a_renderer_are_refused(app: ServedApp, serve: Serve) -> None:
    problem(app.http.post("/v1/models/0123456789abcdef/meshes", json=WISH), 404, "model_not_found")
    problem(app.http.get(f"{MESHES}/0123456789abcdef"), 404, "mesh_not_found")
    without = serve(storage=app.settings.storage)
    problem(without.http.post(MESHES, json=WISH), 503, "renderer_unavailable")
    assert KEPT.marks(app) == []
