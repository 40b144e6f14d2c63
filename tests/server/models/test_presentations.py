"""How models are shown to people, through the SDK and HTTP, on a real server with a real renderer, Redis and storage:
what is kept, the picture from the start view, what links and the page in one file show of it, and what is refused.

Not proved here: what viewers draw (tests/browser).
"""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from splatmill import Client
from splatmill.backplane.storage import layout
from splatmill.errors import InvalidRequest, ServerError
from splatmill.schema import CameraSpec, Presentation
from tests.support.served_app import Serve, ServedApp, problem
from tests.support.servers.rendering import hold_out, serve_in, store_only_ball

pytestmark = pytest.mark.slow

MODEL = "a" * 16
PRESENTATION = f"/v1/models/{MODEL}/presentation"
VIEW = CameraSpec.looking_at((4, 0, 0), (0, 0, 0), width=96, height=64)
BEHIND = CameraSpec.looking_at((-4, 0, 0), (0, 0, 0), width=2000, height=1000)
LENGTH = {"points": [[0, 0, 0], [1, 0, 0]], "name": "the lid"}


@pytest.fixture
def app(serve: Serve, folder: Path, renderer: object) -> ServedApp:
    running = serve_in(serve, folder)
    store_only_ball(running, folder, MODEL, "ball")
    return running


def picture(app: ServedApp, address: str) -> Image.Image:
    answer = app.http.get(f"{address}/files/poster.jpg")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/jpeg"
    return Image.open(io.BytesIO(answer.content)).convert("RGB")


def test_changes_are_kept_each_on_its_own_and_links_show_them(app: ServedApp) -> None:
    link = app.http.post(f"/v1/models/{MODEL}/shares").json()["path"] + "/model"
    assert app.http.get(f"{link}/presentation").json()["annotations"] == []
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        assert model.presentation() == Presentation()
        model.present(measurements=[LENGTH], scale={"factor": 12.5, "unit": "cm"}, auto_rotate=True)
        model.present(annotations=[{"point": [0, 0, 1], "text": "The <b>top</b>"}])
        whole = model.present(background="white")
        assert whole == model.presentation()
        assert whole.measurements[0].name == "the lid"
        assert whole.scale is not None
        assert (whole.scale.factor, whole.scale.unit) == (12.5, "cm")
        assert (whole.annotations[0].text, whole.auto_rotate, whole.start_view) == (
            "The <b>top</b>",
            True,
            None,
        )
        assert app.http.get(f"{link}/presentation").json() == whole.model_dump(mode="json")
        assert model.present(scale=None, measurements=[]).scale is None
        assert model.presentation().annotations == whole.annotations
        refused: tuple[dict[str, Any], ...] = (
            {"annotations": [{"point": [0, 0, 0], "text": ""}]},
            {"annotations": [{"point": [0, 0, 0], "text": "a\x1b[2J"}]},
            {"annotations": [{"point": [0, 0, 0], "text": "x"}] * 101},
            {"scale": {"factor": 0, "unit": "cm"}},
            {"measurements": [{"points": [[0, 0, 0]]}]},
            {"anotations": []},
        )
        for wrong in refused:
            with pytest.raises(InvalidRequest):
                model.present(**wrong)


def test_the_start_view_has_a_picture_that_links_begin_with(app: ServedApp) -> None:
    link = app.http.post(f"/v1/models/{MODEL}/shares").json()["path"]
    listed = [file["name"] for file in app.http.get("/v1/models").json()["models"][0]["files"]]
    assert "poster.jpg" not in listed
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        assert model.present(start_view=VIEW).start_view == VIEW
        first = picture(app, f"/v1/models/{MODEL}")
        assert first.size == (1280, 853)
        right = first.getpixel((640, 426))
        model.present(start_view=BEHIND)
        assert picture(app, f"{link}/model").size == (1280, 640)
        assert picture(app, f"{link}/model").getpixel((640, 320)) != right
        page = app.http.get(link).text
        assert re.findall(r'class="still" src="\S*?/model/files/(\S+)"', page) == ["poster.jpg"]
        assert re.findall(r'og:image" content="\S*/(\S+)"', page) == ["poster.jpg"]
        names = [file["name"] for file in app.http.get("/v1/models").json()["models"][0]["files"]]
        assert "poster.jpg" in names, "lists know of the picture"
        model.present(background="white")
        assert picture(app, f"/v1/models/{MODEL}").getpixel((2, 2)) == (255, 255, 255)
        model.present(start_view=None)
    assert app.http.get(f"/v1/models/{MODEL}/files/poster.jpg").status_code == 404
    assert 'files/preview.jpg"' in app.http.get(link).text


def test_the_page_in_one_file_shows_the_same(app: ServedApp) -> None:
    hold_out(app, MODEL, [VIEW])
    with Client(str(app.http.base_url)) as client:
        client.model(MODEL).present(
            start_view=BEHIND, annotations=[{"point": [0, 0, 0], "text": "</script>"}], background="white"
        )
    page = app.http.get(f"/v1/models/{MODEL}/download/html").text
    match = re.search(r'id="options">(.*?)</script>', page)
    assert match is not None
    options = json.loads(match[1])
    assert options["presentation"]["annotations"] == [{"point": [0, 0, 0], "text": "</script>"}]
    assert options["camera"] == BEHIND.model_dump(mode="json", exclude_none=True)
    assert options["background"] == "white"
    assert options["poster"].startswith("data:image/jpeg;base64,")


def test_nothing_changes_where_the_picture_cannot_be_made(serve: Serve, folder: Path) -> None:
    app = serve(storage=str(folder / "storage"))
    store_only_ball(app, folder, MODEL, "ball")
    app.http.patch(PRESENTATION, json={"auto_rotate": True})
    wish = {"start_view": VIEW.model_dump(mode="json", exclude_none=True), "auto_rotate": False}
    problem(app.http.patch(PRESENTATION, json=wish), 503, "renderer_unavailable")
    assert app.http.get(PRESENTATION).json()["auto_rotate"] is True
    assert app.http.get(PRESENTATION).json()["start_view"] is None
    assert app.http.get(f"/v1/models/{MODEL}/files/poster.jpg").status_code == 404


def test_a_record_of_a_later_version_is_kept_and_a_damaged_field_harms_no_other(app: ServedApp) -> None:
    path, later = layout.presentation(MODEL), b'{"format": 99, "annotations": 3}'
    app.service.storage.put(path, later)
    assert app.http.get(PRESENTATION).json()["annotations"] == []
    problem(app.http.patch(PRESENTATION, json={"auto_rotate": True}), 500, "model_corrupt")
    assert app.service.storage.get(path) == later
    app.service.storage.put(path, json.dumps({"measurements": [LENGTH], "annotations": "none"}).encode())
    assert len(app.http.get(PRESENTATION).json()["measurements"]) == 1
    app.service.storage.put(path, later)
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        with pytest.raises(ServerError):
            model.present(auto_rotate=True)
