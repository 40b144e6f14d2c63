"""Orbit videos that are kept, from a real server with a real renderer, Redis and storage: progress, what is stored,
resumed, cancelled and refused; and the SDK and the command line with them.

Not proved here: the pictures of a video and the path of its camera (tests/worker/render_service).
"""

from __future__ import annotations

import io
import json
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

import av
import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.errors import InvalidRequest, NotFound, ServerError, WaitTimeout
from splatmill.schema import OrbitRequest, Progress
from splatmill.sdk.client import Client
from splatmill_server.background import kept, orbits
from splatmill_server.space import usage
from tests.support.command_line import invoke, spawn
from tests.support.served_app import Serve, ServedApp, problem, stored
from tests.support.servers.rendering import KeptFiles, serve_in, store_only_ball
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

MODEL = "a" * 16
WISH = {"seconds": 1, "fps": 10, "width": 64, "height": 48}
KEPT = KeptFiles("orbits", MODEL, WISH)
ORBITS = KEPT.path


@pytest.fixture(autouse=True)
def _small_parts_and_short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orbits, "PART_FRAMES", (1, 4))
    monkeypatch.setattr(kept, "_PAUSE_SECONDS", 0.02)
    monkeypatch.setattr(kept, "_LOOK_SECONDS", 0.2)


@pytest.fixture
def app(serve: Serve, folder: Path, renderer: subprocess.Popen[bytes]) -> ServedApp:
    running = serve_in(serve, folder)
    store_only_ball(running, folder, MODEL)
    return running


def frames(video: bytes) -> list[Any]:
    with av.open(io.BytesIO(video), "r") as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_video_waits_while_storage_is_listed_for_the_first_time(
    serve: Serve, folder: Path, renderer: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "_PAUSE_SECONDS", 0.3)
    monkeypatch.setattr(usage, "_FIRST_SCAN_SECONDS", 0.1)
    app = serve_in(serve, folder, quota=10**9)
    store_only_ball(app, folder, MODEL)
    orbit = KEPT.begun(app, width=640, height=480, seconds=4)
    # Redis loses the last scan while another process makes a new one.
    app.service.redis.set(keys.SCAN_LOCK, "another process", ex=60)
    app.service.redis.delete(keys.SCAN)
    wait_for(lambda: app.service.orbits._failures)
    app.service.redis.delete(keys.SCAN_LOCK)
    assert KEPT.ended(app, orbit["id"])["state"] == "succeeded"


def test_a_video_is_rendered_in_the_background_kept_and_found_again(app: ServedApp) -> None:
    made = KEPT.begun(app)
    assert (made["state"], made["frames"], made["frames_done"]) == ("queued", 10, 0)
    done = KEPT.ended(app, made["id"])
    assert (done["state"], done["frames_done"], done["request"]["fps"]) == ("succeeded", 10, 10)
    assert KEPT.files(app) == [f"{made['id']}/orbit.json", f"{made['id']}/orbit.mp4"]
    video = app.http.get(done["links"]["video"])
    assert (video.status_code, video.headers["content-type"]) == (200, "video/mp4")
    assert len(video.content) == done["bytes"]
    # The frames are those of the video that a client waits for, in the same order, for all that it came in three parts.
    waited = frames(app.http.post(f"/v1/models/{MODEL}/orbit", json=WISH).content)
    kept = frames(video.content)
    assert len(kept) == len(waited) == 10
    apart = [[abs(one.astype(int) - other).mean() for other in waited] for one in kept]
    assert [row.index(min(row)) for row in apart] == list(range(10))
    part = app.http.get(done["links"]["video"], headers={"Range": "bytes=4-7"})
    assert (part.status_code, part.content) == (206, b"ftyp")
    known = {"If-None-Match": video.headers["etag"]}
    assert app.http.get(done["links"]["video"], headers=known).status_code == 304
    head = app.http.head(done["links"]["video"])
    assert (head.headers["content-length"], head.content) == (str(done["bytes"]), b"")

    again = app.http.post(ORBITS, json=WISH | {"background": "black"})  # which is the default
    assert (again.status_code, again.json()) == (200, done)
    other = KEPT.begun(app, background="white")
    assert other["id"] != made["id"]
    KEPT.ended(app, other["id"])
    listed = app.http.get(ORBITS).json()["orbits"]
    assert [orbit["id"] for orbit in listed] == [other["id"], made["id"]]
    # It counts as what the owner has in storage, and goes with the model.
    app.service.usage.scan()
    listed = app.http.get("/v1/storage").json()["largest"]
    held = sum(entry.size for entry in app.service.storage.entries(layout.model(MODEL)))
    assert [entry["bytes"] for entry in listed if entry["id"] == MODEL] == [held]
    assert app.http.delete(f"/v1/models/{MODEL}/orbits/{other['id']}").status_code == 204
    assert [orbit["id"] for orbit in app.http.get(ORBITS).json()["orbits"]] == [made["id"]]
    problem(app.http.get(other["links"]["video"]), 404, "orbit_not_found")


def test_a_request_without_a_path_keeps_the_id_that_it_had_before_there_were_paths() -> None:
    assert orbits._id_of("etag", OrbitRequest()) == "2a714c9d1a750889"
    view = {"camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "fov_y_deg": 50}
    path = OrbitRequest.model_validate({"camera_path": {"keyframes": [view, view]}})
    assert orbits._id_of("etag", path) != "2a714c9d1a750889"


def test_a_video_that_is_deleted_is_not_rendered_any_further(
    app: ServedApp, renderer: subprocess.Popen[bytes]
) -> None:
    renderer.send_signal(signal.SIGSTOP)
    try:
        made = KEPT.begun(app)
        wait_for(lambda: bool(app.service.orbits.unfinished._working))
        refusal = problem(app.http.get(made["links"]["video"]), 409, "orbit_not_ready")
        assert refusal["facts"]["frames"] == 10
        assert app.http.delete(f"{ORBITS}/{made['id']}").status_code == 204
        wait_for(lambda: not app.service.orbits.unfinished.running)
    finally:
        renderer.send_signal(signal.SIGCONT)
    assert (KEPT.files(app), KEPT.marks(app), app.redis.keys(keys.lease("*", "*"))) == ([], [], [])
    problem(app.http.delete(f"{ORBITS}/{made['id']}"), 404, "orbit_not_found")
    # The renderer is free for others, and the same video can be asked for again.
    assert KEPT.ended(app, KEPT.begun(app)["id"])["state"] == "succeeded"


def test_a_video_goes_on_where_an_api_that_was_stopped_left_it(
    app: ServedApp, serve: Serve, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    next_part = orbits.Orbits._next

    async def nothing() -> None:
        pass

    async def killed_after_four_frames(self: Any, name: str, record: Any) -> Any:
        asked.append(record.frames_done)
        if record.frames_done == 4 and self is app.service.orbits:
            monkeypatch.setattr(self.unfinished, "_take_up", nothing)
            self.unfinished.running[name].cancel()
        return await next_part(self, name, record)

    monkeypatch.setattr(orbits.Orbits, "_next", killed_after_four_frames)
    made = KEPT.begun(app)
    wait_for(lambda: asked == [0, 4])
    wait_for(lambda: not app.service.orbits.unfinished.running)
    between = app.http.get(f"{ORBITS}/{made['id']}").json()
    assert (between["state"], between["frames_done"]) == ("running", 4)
    second = serve_in(serve, folder)
    done = KEPT.ended(second, made["id"])
    assert (done["state"], asked) == ("succeeded", [0, 4, 4, 8, 10])
    assert len(frames(second.http.get(done["links"]["video"]).content)) == 10


def test_a_renderer_that_is_away_is_waited_for_and_one_that_dies_is_asked_again(
    serve: Serve,
    folder: Path,
    renderer: subprocess.Popen[bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    address = tmp_path / "r.sock"
    app = serve(renderer_url=f"unix:{address}", storage=str(folder / "storage"))
    store_only_ball(app, folder, MODEL)
    counted: list[bool] = []
    ask = app.service.orbits._ask

    async def heard(*args: Any) -> None:
        try:
            await ask(*args)
        except kept.Delayed as delay:
            counted.append(delay.counts)
            raise

    monkeypatch.setattr(app.service.orbits, "_ask", heard)
    made = KEPT.begun(app)
    wait_for(lambda: len(counted) > kept.MAX_ATTEMPTS)
    assert not any(counted), "a renderer that cannot be reached has tried nothing"
    assert app.http.get(f"{ORBITS}/{made['id']}").json()["state"] == "queued"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(address))
        listener.listen()
        connection, _ = listener.accept()
        connection.recv(1)
        connection.close()  # as by a process that is killed while it renders
        wait_for(lambda: any(counted))
    address.unlink()
    address.symlink_to(folder / "r.sock")
    assert KEPT.ended(app, made["id"])["state"] == "succeeded"


def test_a_video_that_cannot_be_rendered_has_failed_with_the_reason(app: ServedApp) -> None:
    storage = app.service.storage
    storage.put(layout.model_file(MODEL, "model.ply"), b"no model")
    made = KEPT.begun(app)
    failed = KEPT.ended(app, made["id"])
    assert (failed["state"], failed["problem"]["code"]) == ("failed", "model_corrupt")
    refusal = problem(app.http.get(made["links"]["video"]), 409, "orbit_not_ready")
    assert "problem" in refusal["advice"]
    # Asked for again, it is begun again.
    again = app.http.post(ORBITS, json=WISH)
    assert (again.status_code, again.json()["id"], again.json()["state"]) == (202, made["id"], "queued")
    assert again.json().get("problem") is None
    assert KEPT.ended(app, made["id"])["state"] == "failed"


def test_the_video_of_a_deleted_model_leaves_nothing(
    app: ServedApp, renderer: subprocess.Popen[bytes]
) -> None:
    renderer.send_signal(signal.SIGSTOP)
    try:
        KEPT.begun(app)
        wait_for(lambda: bool(app.service.orbits.unfinished._working))
        app.service.storage.delete_prefix(layout.model(MODEL))
    finally:
        renderer.send_signal(signal.SIGCONT)
    wait_for(lambda: KEPT.marks(app) == [])
    assert not [path for path in stored(app) if path.startswith(layout.model(MODEL))]


def test_what_is_refused_is_refused_before_it_waits(
    app: ServedApp, renderer: subprocess.Popen[bytes], serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    for changed in ({"width": 33}, {"seconds": 0}, {"fps": 61}, {"height": "x"}, {"speed": 2}):
        answer = app.http.post(ORBITS, json=WISH | changed)
        assert answer.status_code == 422, answer.text
        problem(answer, 422, answer.json()["code"])
    problem(app.http.post("/v1/models/0123456789abcdef/orbits", json=WISH), 404, "model_not_found")
    problem(app.http.get(f"{ORBITS}/..%2f..%2fx"), 404, "not_found")
    problem(app.http.get(f"{ORBITS}/0123456789abcdef"), 404, "orbit_not_found")
    monkeypatch.setattr(orbits.Orbits, "most_unfinished", 2)
    monkeypatch.setattr(orbits.Orbits, "most_of_model", 2)
    renderer.send_signal(signal.SIGSTOP)
    try:
        two = [KEPT.begun(app)["id"], KEPT.begun(app, fps=11)["id"]]
        refusal = problem(app.http.post(ORBITS, json=WISH | {"fps": 12}), 409, "too_many_orbits")
        assert refusal["facts"]["limit"] == 2
        assert "owner" in refusal["detail"]
        KEPT.begun(app)  # which waits already
        assert len(app.service.orbits.unfinished.running) <= 1, "videos of an owner are rendered one by one"
    finally:
        renderer.send_signal(signal.SIGCONT)
    for orbit_id in two:
        KEPT.ended(app, orbit_id)
    refusal = problem(app.http.post(ORBITS, json=WISH | {"fps": 12}), 409, "too_many_orbits")
    assert MODEL in refusal["detail"]
    without = serve(storage=app.settings.storage)
    problem(without.http.post(ORBITS, json=WISH), 503, "renderer_unavailable")


def test_a_broken_record_hides_no_other(app: ServedApp) -> None:
    made = KEPT.ended(app, KEPT.begun(app)["id"])
    broken = {"id": "0" * 16, "model": MODEL, "state": "later"}
    app.service.storage.put(layout.kept_record(MODEL, "orbits", "0" * 16), json.dumps(broken).encode())
    assert [orbit["id"] for orbit in app.http.get(ORBITS).json()["orbits"]] == [made["id"]]


def test_the_sdk_waits_with_progress_and_renders_nothing_twice(
    app: ServedApp, renderer: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    heard: list[Progress] = []
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        path = model.orbit(tmp_path, on_progress=heard.append, seconds=1, fps=10, width=64, height=48)
        assert path == tmp_path / "orbit.mp4"
        assert len(frames(path.read_bytes())) == 10
        assert (heard[-1].stage, heard[-1].done, heard[-1].total) == ("rendering", 10, 10)
        kept = model.orbits.list()
        renderer.send_signal(signal.SIGSTOP)  # stored videos need no renderer
        try:
            model.orbit(tmp_path / "again.mp4", seconds=1, fps=10, width=64, height=48)
            with pytest.raises(WaitTimeout, match="orbit video"):
                model.orbit(tmp_path, timeout=0.2, fps=5)
        finally:
            renderer.send_signal(signal.SIGCONT)
        assert (tmp_path / "again.mp4").read_bytes() == path.read_bytes()
        late = model.orbits.list()[0]
        assert (late.request.fps, len(model.orbits.list())) == (5, len(kept) + 1)
        model.orbits.delete(late.id)
        with pytest.raises(NotFound):
            model.orbits.wait(late.id)
        assert len(frames(model.orbit(tmp_path, keep=False, seconds=1, fps=3).read_bytes())) == 3
        assert model.orbits.list() == kept
        with pytest.raises(InvalidRequest, match="multiple of 2"):
            model.orbit(tmp_path, width=33)
        app.service.storage.put(layout.model_file(MODEL, "model.ply"), b"no model")
        with pytest.raises(ServerError, match="could not be read"):
            model.orbit(tmp_path)


def test_the_command_shows_progress_and_an_interrupt_cancels_the_video(
    app: ServedApp, renderer: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    server = ("--server", str(app.http.base_url))
    wish = ("--seconds", "1", "--fps", "10", "--width", "64", "--height", "48")
    done = invoke("orbit", MODEL, "-o", tmp_path / "o.mp4", *wish, *server)
    assert done.exit_code == 0, done.output
    assert "rendering  10/10" in done.output
    assert len(frames((tmp_path / "o.mp4").read_bytes())) == 10
    renderer.send_signal(signal.SIGSTOP)
    try:
        command = spawn("orbit", MODEL, "-o", tmp_path / "never.mp4", *server)
        wait_for(lambda: bool(app.service.orbits.unfinished._working))
        # It has heard of its video once it shows how far that is.
        assert command.stdout is not None
        assert "rendering  0/144" in command.stdout.readline()
        command.send_signal(signal.SIGINT)
        assert command.wait(20) == 130
        command.communicate()
        assert [orbit["frames"] for orbit in app.http.get(ORBITS).json()["orbits"]] == [10]
        wait_for(lambda: not app.service.orbits.unfinished.running)
    finally:
        renderer.send_signal(signal.SIGCONT)
    assert KEPT.marks(app) == []
    assert not (tmp_path / "never.mp4").exists()


def test_a_video_has_failed_after_an_error_that_nobody_expected(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    async def broken(*_: object) -> None:
        asked.append(1)
        raise RecursionError

    monkeypatch.setattr(kept, "post", broken)
    made = KEPT.begun(app)
    wait_for(lambda: app.http.get(made["links"]["self"]).json()["state"] == "failed")
    assert "RecursionError" in app.http.get(made["links"]["self"]).json()["problem"]["detail"]
    assert not list(app.service.storage.entries(layout.unfinished_kept("orbits")))
    assert len(asked) == 1
