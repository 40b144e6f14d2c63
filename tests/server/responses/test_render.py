"""Forwarding to a renderer that is a real HTTP process of its own, on a unix socket, and every bad camera.

Not proved here: pictures. The renderer of these tests answers with what it was asked for.
"""

import asyncio
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI, Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from splatmill.backplane import rendering
from splatmill.schema import DEFAULT_OWNER, RenderRequest
from tests.support.served_app import Serve, ServedApp, problem, store_model
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

MODEL = "a" * 16
EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]]
CAMERA: dict[str, Any] = {"camera_to_world": EYE, "width": 64, "height": 48, "fov_y_deg": 50}

SLOW_FPS = 7
"""The renderer of these tests answers a video of this speed only when its client has left."""

ASKED, LEFT = threading.Event(), threading.Event()

CLIENTS: list[tuple[str, str]] = []
"""The kind of each request, and whose it is as the renderer learns."""


@pytest.fixture
def renderer(tmp_path: Path) -> Iterator[str]:
    """A renderer that echoes requests; the address to reach it by."""
    echo = FastAPI()

    @echo.post("/v1/models/{model_id}/{kind}")
    async def answer(model_id: str, kind: str, request: Request) -> Response:
        body = await request.body()
        CLIENTS.append((kind, request.headers.get("splatmill-client", "")))
        if json.loads(body).get("fps") == SLOW_FPS:
            ASKED.set()
            while not await request.is_disconnected():
                await asyncio.sleep(0.01)
            LEFT.set()
        if b'"jpeg"' in body:
            return JSONResponse({"code": "render_failed"}, 500, media_type="application/problem+json")
        etag = f'"{hash(body):x}"'
        if request.headers.get("if-none-match") == etag:
            return Response(status_code=304, headers={"ETag": etag})

        async def pieces() -> Any:
            for _ in range(3):
                yield (
                    json.dumps({"model": model_id, "kind": kind, "asked": json.loads(body)}).encode() + b"\n"
                )

        headers = {
            "ETag": etag,
            "Splatmill-Depth-Scale": "0.5",
            "Splatmill-Request": request.headers["x-request-id"],
            "Set-Cookie": "no=1",
            "Cache-Control": "private",
        }
        return StreamingResponse(pieces(), headers=headers, media_type="image/png")

    path = tmp_path / "s"
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    server = uvicorn.Server(uvicorn.Config(echo, log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    wait_for(lambda: server.started)
    yield f"unix:{path}"
    server.should_exit = True
    thread.join(60)


@pytest.fixture
def app(serve: Serve, renderer: str) -> ServedApp:
    running = serve(renderer_url=renderer)
    store_model(running.service, MODEL)
    return running


def test_a_picture_is_passed_on_with_what_belongs_to_it(app: ServedApp) -> None:
    answer = app.http.post(
        f"/v1/models/{MODEL}/render",
        json={"camera": CAMERA, "output": "depth"},
        headers={"X-Request-ID": "ann-7"},
    )
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/png"
    assert answer.headers["splatmill-request"] == "ann-7", "the log of the renderer names the request"
    assert answer.headers["splatmill-depth-scale"] == "0.5"
    assert "set-cookie" not in answer.headers
    lines = [json.loads(line) for line in answer.content.splitlines()]
    assert len(lines) == 3
    assert (lines[0]["model"], lines[0]["kind"], lines[0]["asked"]["output"]) == (MODEL, "render", "depth")
    again = app.http.post(
        f"/v1/models/{MODEL}/render",
        json={"camera": CAMERA, "output": "depth"},
        headers={"If-None-Match": answer.headers["etag"]},
    )
    assert (again.status_code, again.content) == (304, b"")
    counted = app.http.get("/metrics").text
    assert 'splatmill_renders_total{kind="render",result="made"} 1.0' in counted
    assert 'splatmill_renders_total{kind="render",result="not_modified"} 1.0' in counted
    assert 'splatmill_render_seconds_count{kind="render"} 1.0' in counted


def test_the_cacheable_address_asks_for_the_same_picture(app: ServedApp) -> None:
    wish = RenderRequest.model_validate({"camera": CAMERA, "format": "webp", "background": "white"})
    posted = app.http.post(
        f"/v1/models/{MODEL}/render",
        content=wish.model_dump_json(),
        headers={"Content-Type": "application/json"},
    )
    got = app.http.get(f"/v1/models/{MODEL}/render", params=wish.to_query())
    assert got.status_code == 200
    assert (
        json.loads(got.content.splitlines()[0])["asked"]
        == json.loads(posted.content.splitlines()[0])["asked"]
    )
    problem(app.http.get(f"/v1/models/{MODEL}/render"), 422, "camera_invalid")
    bad = wish.to_query() | {"camera_to_world": "1,2,x"}
    problem(app.http.get(f"/v1/models/{MODEL}/render", params=bad), 422, "camera_invalid")


def test_a_video_with_and_without_wishes(app: ServedApp) -> None:
    video = app.http.post(f"/v1/models/{MODEL}/orbit", json={"seconds": 2})
    assert json.loads(video.content.splitlines()[0])["asked"]["seconds"] == 2
    assert app.http.post(f"/v1/models/{MODEL}/orbit").status_code == 200
    problem(app.http.post(f"/v1/models/{MODEL}/orbit", json={"width": 100_000}), 422, "size_out_of_range")


def test_the_renderer_learns_that_the_client_has_left(app: ServedApp) -> None:
    ASKED.clear()
    LEFT.clear()
    wish = app.http.build_request("POST", f"/v1/models/{MODEL}/orbit", json={"fps": SLOW_FPS})
    lines = [f"POST {wish.url.path} HTTP/1.1", *(f"{name}: {value}" for name, value in wish.headers.items())]
    with socket.create_connection((wish.url.host, wish.url.port)) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode() + wish.read())
        assert ASKED.wait(20)
    assert LEFT.wait(20)
    abandoned = 'splatmill_renders_total{kind="orbit",result="abandoned"} 1.0'
    wait_for(lambda: abandoned in app.http.get("/metrics").text)
    assert app.http.post(f"/v1/models/{MODEL}/orbit").status_code == 200


SHEARED = [[1, 0.5, 0, 0], [0, 0.87, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"camera_to_world": [[0] * 4] * 3 + [[0, 0, 0, 1]]}, "camera_invalid"),
        ({"camera_to_world": SHEARED}, "camera_invalid"),
        ({"camera_to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}, "camera_invalid"),
        ({"camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 1]]}, "camera_invalid"),
        ({"camera_to_world": [[1, 0], [0, 1]]}, "camera_invalid"),
        ({"camera_to_world": "NaN"}, "camera_invalid"),
        ({"fov_y_deg": None}, "camera_invalid"),
        ({"fov_y_deg": 0}, "camera_invalid"),
        ({"width": 0}, "size_out_of_range"),
        ({"width": 100_000}, "size_out_of_range"),
        ({"height": -1}, "size_out_of_range"),
        ({"width": 8192, "height": 8192}, "size_out_of_range"),
        ({"zoom": 3}, "camera_invalid"),
    ],
)
def test_cameras_that_cannot_be_rendered_from_are_refused(
    app: ServedApp, change: dict[str, Any], code: str
) -> None:
    refused = problem(
        app.http.post(f"/v1/models/{MODEL}/render", json={"camera": CAMERA | change}), 422, code
    )
    assert refused["facts"]["errors"]
    assert app.http.post(f"/v1/models/{MODEL}/render", json={"camera": CAMERA}).status_code == 200


def test_numbers_that_are_not_finite_are_refused(app: ServedApp) -> None:
    for word in ("NaN", "Infinity", "1e999"):
        body = json.dumps({"camera": CAMERA}).replace("-4", word)
        answer = app.http.post(
            f"/v1/models/{MODEL}/render", content=body, headers={"Content-Type": "application/json"}
        )
        problem(answer, 422, "camera_invalid")


def test_the_renderers_own_problems_pass_through(app: ServedApp) -> None:
    wish = {"camera": CAMERA, "format": "jpeg"}
    answer = app.http.post(f"/v1/models/{MODEL}/render", json=wish)
    assert (answer.status_code, answer.json()) == (500, {"code": "render_failed"})


def test_the_renderer_learns_whose_each_request_is(app: ServedApp) -> None:
    CLIENTS.clear()
    address = f"/v1/models/{MODEL}"
    assert app.http.post(f"{address}/render", json={"camera": CAMERA}).status_code == 200
    app.http.post(f"{address}/edits", json={"min_opacity": 0.5, "preview": True})
    app.http.get(f"{address}/download/sog")
    link = app.http.post(f"{address}/shares", json={}).json()["token"]
    query = RenderRequest.model_validate({"camera": CAMERA}).to_query()
    assert app.http.get(f"/s/{link}/model/render", params=query).status_code == 200
    kinds = [kind for kind, _ in CLIENTS]
    assert kinds == ["render", "edits", "convert", "render"]
    owners = [client.split("/")[0] for _, client in CLIENTS]
    machines = [client.split("/")[1] for _, client in CLIENTS]
    assert owners[:3] == [rendering.client_of(DEFAULT_OWNER, "").split("/")[0]] * 3
    # Visitors of a link are apart from the owner of the model, and from visitors of other owners' models.
    assert owners[3] == rendering.client_of(f"visitors of {DEFAULT_OWNER}", "").split("/")[0]
    assert machines[0] == machines[1] == machines[3] != machines[2]


def test_without_a_renderer_pictures_are_503_and_files_still_come(serve: Serve, tmp_path: Path) -> None:
    for settings in ({}, {"renderer_url": f"unix:{tmp_path}/gone"}, {"renderer_url": "http://127.0.0.1:9"}):
        app = serve(**settings)
        store_model(app.service, MODEL)
        answer = app.http.post(f"/v1/models/{MODEL}/render", json={"camera": CAMERA})
        assert problem(answer, 503, "renderer_unavailable")["advice"]
        assert app.http.get(f"/v1/models/{MODEL}/files/model.ply").status_code == 200


def test_a_renderer_that_hangs_is_given_up(serve: Serve, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        app = serve(renderer_url=f"http://127.0.0.1:{silent.getsockname()[1]}", orbit_timeout=0.2)
        store_model(app.service, MODEL)
        problem(app.http.post(f"/v1/models/{MODEL}/orbit"), 504, "render_timeout")


def test_models_that_are_not_there_are_said_so_before_rendering(app: ServedApp) -> None:
    problem(
        app.http.post("/v1/models/0123456789abcdef/render", json={"camera": CAMERA}), 404, "model_not_found"
    )
    problem(app.http.post(f"/v1/models/{app.job()}/render", json={"camera": CAMERA}), 409, "model_not_ready")
    problem(
        app.http.post(f"/v1/models/{MODEL}/render", content=b"{}", headers={"Content-Type": "text/plain"}),
        415,
        "unsupported_media_type",
    )


def test_an_etag_of_other_bytes_than_ascii_is_not_passed_on(app: ServedApp) -> None:
    for etag in (b"\xff\xe9", b'"\xc3\xa9"', b"a" * 5000):
        headers = {b"If-None-Match": etag, b"Content-Type": b"application/json"}
        body = json.dumps({"camera": CAMERA}).encode()
        assert app.http.post(f"/v1/models/{MODEL}/render", content=body, headers=headers).status_code == 200
