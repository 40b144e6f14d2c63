"""Models downloaded in other formats from a real server with a real renderer, Redis and storage: bytes, quality on
held-out photos, ranges, what is kept, what is made once, and what is refused.

Not proved here: the formats themselves (tests/worker/splat/formats).
"""

from __future__ import annotations

import base64
import re
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from splatmill.backplane.storage import layout
from splatmill.errors import NotFound
from splatmill.schema import (
    CONVERSION_HEADER,
    CONVERSION_VERSION,
    CameraSpec,
    Conversion,
    ModelCamera,
    ModelCameras,
)
from splatmill.sdk.client import Client
from splatmill_server.responses import single_file
from splatmill_server.responses.single_file import WEB
from splatmill_worker.splat.formats import registry
from tests.support.ball import write_ply
from tests.support.command_line import invoke
from tests.support.programs import npm_package
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.rendering import hold_out, serve_in, store_only_ball
from tests.support.servers.scripted_server import Reply, scripted_server
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

MODEL = "a" * 16
VIEWS = [CameraSpec.looking_at((4, side, 0), (0, 0, 0), width=96, height=64) for side in (0, 1, 2)]


@pytest.fixture
def app(serve: Serve, folder: Path, renderer: subprocess.Popen[bytes]) -> ServedApp:
    running = serve_in(serve, folder)
    store_only_ball(running, folder, MODEL)
    return running


def _formats(app: ServedApp) -> dict[str, dict[str, Any]]:
    answer = app.http.get(f"/v1/models/{MODEL}/formats")
    assert answer.status_code == 200
    return {entry["format"]: entry for entry in answer.json()["formats"]}


def test_a_format_is_made_once_and_kept_with_its_quality_on_held_out_photos(
    app: ServedApp, tmp_path: Path
) -> None:
    hold_out(app, MODEL, VIEWS)
    before = _formats(app)
    assert before["ply"]["bytes"] == before["ply"]["bytes"] > 0
    assert before["sog"]["bytes"] is None
    assert before["sog"]["conversion"] is None
    assert "PlayCanvas" in before["sog"]["readers"]
    answer = app.http.get(f"/v1/models/{MODEL}/download/sog")
    assert answer.status_code == 200
    assert answer.headers["content-disposition"] == f"attachment; filename*=UTF-8''{MODEL}.sog"
    (tmp_path / "m.sog").write_bytes(answer.content)
    assert registry.read(tmp_path / "m.sog").gaussians.count == 400
    sog = _formats(app)["sog"]
    made = sog["conversion"]
    assert sog["bytes"] == len(answer.content) < before["ply"]["bytes"]
    assert (made["compared_with"], made["pictures"], made["psnr_before"]) == ("held_out", 3, 50.0)
    assert 30 < made["psnr"] < 70  # against the model's own 8-bit pictures; the magenta half does not count
    assert 0.9 < made["ssim"] <= 1
    record = app.service.storage.head(layout.conversion_record(MODEL, "sog"))
    again = app.http.get(f"/v1/models/{MODEL}/download/sog", headers={"Range": "bytes=0-3"})
    assert (again.status_code, again.content) == (206, b"PK\x03\x04")
    known = {"If-None-Match": answer.headers["etag"]}
    assert app.http.get(f"/v1/models/{MODEL}/download/sog", headers=known).status_code == 304
    head = app.http.head(f"/v1/models/{MODEL}/download/sog")
    assert (head.headers["content-length"], head.content) == (str(len(answer.content)), b"")
    assert app.service.storage.head(layout.conversion_record(MODEL, "sog")) == record, "made a second time"


def test_without_held_out_photos_pictures_of_the_model_are_compared(app: ServedApp) -> None:
    cameras = ModelCameras(cameras=[ModelCamera(name="a.jpg", camera=VIEWS[0])])
    app.service.storage.put(layout.model_file(MODEL, "cameras.json"), cameras.model_dump_json().encode())
    assert app.http.get(f"/v1/models/{MODEL}/download/compressed.ply").status_code == 200
    made = _formats(app)["compressed.ply"]["conversion"]
    assert (made["compared_with"], made["pictures"]) == ("renderings", 1)
    assert made["psnr"] > 30
    assert "psnr_before" not in made or made["psnr_before"] is None
    app.service.storage.put(layout.model_file(MODEL, "cameras.json"), b'{"cameras": []}')
    assert app.http.get(f"/v1/models/{MODEL}/download/glb").status_code == 200
    assert _formats(app)["glb"]["conversion"].get("psnr") is None


def test_requests_at_once_in_two_api_processes_make_one_conversion(
    app: ServedApp, serve: Serve, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = serve_in(serve, folder)
    stored = []
    for each in (app, other):
        assert (
            each.http.get(f"/v1/models/{MODEL}/formats").status_code == 200
        )  # its routes are built one at a time
        put = each.service.storage.put

        def counted(path: str, data: Any, put: Any = put) -> None:
            stored.append(path)
            put(path, data)

        monkeypatch.setattr(each.service.storage, "put", counted)
    addresses = [f"{each.http.base_url}/v1/models/{MODEL}/download/spz" for each in (app, other) * 3]
    with ThreadPoolExecutor(6) as pool:
        answers = list(
            pool.map(lambda address: httpx.get(address, timeout=60, trust_env=False, verify=False), addresses)
        )
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.content for answer in answers}) == 1
    assert stored == [layout.conversion_record(MODEL, "spz")]


def test_a_conversion_nobody_waits_for_is_given_up_and_nothing_is_left(
    app: ServedApp, folder: Path, renderer: subprocess.Popen[bytes]
) -> None:
    renderer.send_signal(signal.SIGSTOP)
    try:
        with pytest.raises(httpx.ReadTimeout):
            app.http.get(f"/v1/models/{MODEL}/download/sog", timeout=0.5)
        wait_for(lambda: not app.service.conversions._running)
    finally:
        renderer.send_signal(signal.SIGCONT)
    assert app.http.get(f"/v1/models/{MODEL}/download/sog").status_code == 200
    wait_for(lambda: not list((folder / "tmp").glob("splatmill-convert-*")))


def test_a_model_that_changed_is_converted_again_and_a_deleted_one_takes_its_formats_along(
    app: ServedApp, folder: Path
) -> None:
    first = app.http.get(f"/v1/models/{MODEL}/download/sog")
    write_ply(folder / "model.ply", 300)
    app.service.storage.put(layout.model_file(MODEL, "model.ply"), folder / "model.ply")
    assert _formats(app)["sog"]["bytes"] is None
    second = app.http.get(f"/v1/models/{MODEL}/download/sog")
    assert len(second.content) < len(first.content)
    assert app.http.delete(f"/v1/jobs/{MODEL}").status_code in (200, 202, 204)
    assert not list(app.service.storage.entries(layout.model(MODEL)))
    problem(app.http.get(f"/v1/models/{MODEL}/download/sog"), 404, "model_not_found")


def test_refusals(app: ServedApp, serve: Serve, folder: Path) -> None:
    refusal = problem(app.http.get(f"/v1/models/{MODEL}/download/obj"), 404, "format_unknown")
    assert "sog" in refusal["facts"]["formats"]
    problem(app.http.get(f"/v1/models/{'b' * 16}/download/sog"), 404, "model_not_found")
    problem(app.http.get(f"/v1/models/{'b' * 16}/formats"), 404, "model_not_found")
    ply = app.http.get(f"/v1/models/{MODEL}/download/ply")
    assert ply.content == (folder / "model.ply").read_bytes()
    without = serve(storage=str(folder / "storage"))
    problem(without.http.get(f"/v1/models/{MODEL}/download/sog"), 503, "renderer_unavailable")
    assert without.http.get(f"/v1/models/{MODEL}/download/ply").status_code == 200
    app.service.storage.put(layout.model_file(MODEL, "model.ply"), b"ply\nnot a model")
    problem(app.http.get(f"/v1/models/{MODEL}/download/sog"), 500, "model_corrupt")


def test_a_renderer_that_ends_within_its_answer_is_asked_again(
    serve: Serve, folder: Path, app: ServedApp
) -> None:
    """The problem lets a client repeat its request, and nothing of the answer is kept."""
    record = Conversion(model="etag", version=CONVERSION_VERSION, gaussians=1, seconds=0.1)
    cut = Reply(200, b"x" * 1000, {CONVERSION_HEADER: record.model_dump_json()}, cut=500)
    with scripted_server() as server:
        server.answer = lambda _: cut
        broken = serve(renderer_url=server.url, storage=str(folder / "storage"))
        answer = broken.http.get(f"/v1/models/{MODEL}/download/spz")
    refusal = problem(answer, 503, "renderer_unavailable")
    assert "ended while it sent" in refusal["detail"]
    assert answer.headers["retry-after"] == "5"
    assert _formats(app)["spz"]["bytes"] is None


def test_the_model_with_its_viewer_in_one_file(app: ServedApp) -> None:
    address = f"/v1/models/{MODEL}/download/html"
    if not (WEB / "vendor/playcanvas").is_dir():
        problem(app.http.get(address), 500, "conversion_failed")
        return
    answer = app.http.get(address)
    assert answer.status_code == 200
    assert answer.headers["content-disposition"].startswith("attachment")
    assert answer.headers["content-security-policy"] == "sandbox allow-scripts"
    model = app.service.storage.get(layout.conversion(MODEL, "sog"))
    assert base64.b64encode(model) in answer.content


def test_a_large_model_is_in_the_file_in_levels(app: ServedApp, monkeypatch: pytest.MonkeyPatch) -> None:
    npm_package("playcanvas")  # it is in the file
    monkeypatch.setattr(single_file, "MANY", 399)  # the model has 400 Gaussians
    answer = app.http.get(f"/v1/models/{MODEL}/download/html")
    assert answer.status_code == 200
    model = app.service.storage.get(layout.conversion(MODEL, "lod.zip"))
    assert base64.b64encode(model) in answer.content
    assert b'"levels": true' in answer.content


def test_the_page_and_the_file_hold_the_same_format() -> None:
    source = (WEB / "page/viewer/small_file.js").read_text()
    assert f'WHOLE = "{single_file.WHOLE}"' in source
    assert f'IN_PARTS = "{single_file.IN_PARTS}"' in source
    assert re.findall(r"MANY = 2 \*\* (\d+);", source) == [str(single_file.MANY.bit_length() - 1)]
    assert single_file.held_format(single_file.MANY) == "sog"
    assert single_file.held_format(single_file.MANY + 1) == "lod.zip"


def test_the_sdk_and_the_command_line_download_formats(app: ServedApp, tmp_path: Path) -> None:
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        path = model.download_as("sog", tmp_path)
        assert path == tmp_path / f"{MODEL}.sog"
        assert registry.read(path).gaussians.count == 400
        known = {each.format: each.bytes for each in model.formats()}
        assert known["sog"] == path.stat().st_size
        with pytest.raises(NotFound, match="no format"):
            model.download_as("obj", tmp_path)
    done = invoke(
        "download", MODEL, "--format", "glb", "-o", tmp_path / "out", "--server", str(app.http.base_url)
    )
    assert done.exit_code == 0, done.output
    assert done.stdout.split() == [str(tmp_path / "out/model.glb")]
    assert registry.read(tmp_path / "out/model.glb").gaussians.count == 400
