"""Models made of a part of another one through the SDK, synchronous and asynchronous, and through `splatmill edit`, on
a real server with a real renderer, Redis and storage.

Not proved here: which Gaussians an edit keeps, and that its error is right (tests/worker/render_service/test_edit.py).
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from PIL import Image

from splatmill import AsyncClient, Client
from splatmill.backplane.storage import layout
from splatmill.cli.exits import Exit
from splatmill.errors import InvalidRequest, NotFound
from splatmill.schema import CameraSpec
from splatmill_worker.splat.formats import ply
from tests.support.command_line import invoke
from tests.support.served_app import Serve, ServedApp
from tests.support.servers.rendering import hold_out, serve_in, store_only_ball
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

MODEL = "a" * 16
VIEWS = [CameraSpec.looking_at((4, side, 0), (0, 0, 0), width=96, height=64) for side in (0, 1)]
RIGHT = {"min": [0, -2, -2], "max": [2, 2, 2]}
"""The red half of the ball."""


@pytest.fixture
def app(serve: Serve, folder: Path, renderer: object) -> ServedApp:
    running = serve_in(serve, folder)
    store_only_ball(running, folder, MODEL, "ball")
    return running


def test_a_part_of_a_model_becomes_a_new_one(app: ServedApp, folder: Path, tmp_path: Path) -> None:
    hold_out(app, MODEL, VIEWS)
    app.service.storage.put(layout.model_file(MODEL, "frame.json"), b'{"unit": "metre"}')
    of_the_whole = json.dumps({"result": {"psnr": 9.0, "lpips_vgg": 0.1, "mse": 0.2, "steps": 30}})
    app.service.storage.put(layout.model_file(MODEL, "report.json"), of_the_whole.encode())
    right = int((ply.read(folder / "model.ply").gaussians.means[:, 0] >= 0).sum())
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        preview = model.edit(box=RIGHT, preview=True)
        assert (preview.model, preview.gaussians_before, preview.gaussians) == (None, 400, right)
        assert [view.name for view in preview.views] == ["0.jpg", "1.jpg"]
        assert preview.psnr_before is not None
        assert preview.psnr is not None
        assert preview.psnr < preview.psnr_before, "the ball's left half shows in the second photo"
        assert len([*client.models()]) == 1
        made = model.edit(box=RIGHT, min_opacity=0.1, name="half a ball")
        assert made.model is not None
        half = client.model(made.model)
        assert (half.model.name, half.model.gaussians) == ("half a ball", right)
        assert half.model.psnr is None, "the photos show what was cropped"
        assert ply.read(half.download(tmp_path / "half.ply")).gaussians.means[:, 0].min() >= 0
        assert json.loads(half.download(tmp_path / "frame.json", file="frame.json").read_text()) == {
            "unit": "metre"
        }
        assert {view.psnr for view in half.cameras()} == {None}
        report = json.loads(half.download(tmp_path / "report.json", file="report.json").read_text())
        assert (report["result"]["psnr"], report["edit"]["psnr"]) == (None, made.psnr)
        cleaned = model.edit(min_opacity=0.1)
        assert cleaned.model is not None
        clean = client.model(cleaned.model)
        assert (clean.model.name, clean.model.psnr) == ("ball, cleaned", cleaned.psnr)
        result = json.loads(clean.download(tmp_path / "clean.json", file="report.json").read_text())["result"]
        measured = [result[name] for name in ("psnr", "lpips_vgg", "mse", "steps")]
        assert measured == [cleaned.psnr, None, None, 30]
        assert client.model(MODEL).model.gaussians == 400
        assert half.presentation().start_view == VIEWS[0], (
            "it begins where the first held-out photo was taken"
        )
        with Image.open(half.download(tmp_path / "poster.jpg", file="poster.jpg")) as picture:
            assert picture.size == (1280, 853)
        model.present(annotations=[{"point": (0, 0, 1), "text": "The top"}], start_view=VIEWS[1])
        again = model.edit(box=RIGHT)
        assert again.model is not None
        assert client.model(again.model).model.name == "ball, cropped"
        assert client.model(again.model).presentation() == model.presentation(), "what was written is kept"
        for wrong in ({}, {"box": {"min": [0, 0, 0], "max": [0, 1, 1]}}, {"min_opacity": 2.0}):
            with pytest.raises(InvalidRequest):
                model.edit(**wrong)
        with pytest.raises(InvalidRequest, match="leaves no Gaussian"):
            model.edit(max_size=1e-6)


def test_the_asynchronous_twin(app: ServedApp) -> None:
    async def live() -> None:
        async with AsyncClient(str(app.http.base_url)) as client:
            made = await (await client.model(MODEL)).edit(box=RIGHT)
            assert made.psnr is None, "there are no held-out photos"
            assert (await client.model(str(made.model))).model.gaussians == made.gaussians

    asyncio.run(live())


def test_the_command_says_what_is_left_out(app: ServedApp) -> None:
    hold_out(app, MODEL, VIEWS)
    at = ("--server", str(app.http.base_url))
    corners = ("--box", "0", "-2", "-2", "2", "2", "2")
    preview = invoke("edit", MODEL, *corners, "--preview", *at)
    assert (preview.exit_code, preview.stdout.count("\n")) == (0, 1), preview.output
    assert preview.stdout.endswith(
        " of 400 Gaussians would be left out. The photos show what is left out, so they do not measure what is left.\n"
    )
    record = json.loads(invoke("edit", MODEL, *corners, "--preview", "--json", *at).stdout)
    assert f"{400 - record['gaussians']} of 400" in preview.stdout
    assert record["crops"] is True
    cleaned = invoke("edit", MODEL, "--min-opacity", "0.1", "--preview", *at)
    assert " of 400 Gaussians would be left out. PSNR on 2 held-out photos: " in cleaned.stdout
    clean = json.loads(invoke("edit", MODEL, "--min-opacity", "0.1", "--preview", "--json", *at).stdout)
    assert clean["crops"] is False
    assert f"{clean['psnr_before']:.2f} dB before, {clean['psnr']:.2f} dB after." in cleaned.stdout
    done = invoke("edit", MODEL, *corners, "--name", "half", *at)
    with Client(str(app.http.base_url)) as client:
        made = client.model(done.stdout.splitlines()[-1].removeprefix("model "))
        assert (made.model.name, made.model.gaussians) == ("half", record["gaussians"])
        made.delete()
        with pytest.raises(NotFound):
            client.model(made.id)
    nothing = invoke("edit", MODEL, *at)
    assert nothing.exit_code == Exit.usage
    assert "give --box, --min-opacity or --max-size" in nothing.output
    refused = invoke("edit", MODEL, "--max-size", "0.000001", *at)
    assert refused.exit_code == Exit.refused
    assert "leaves no Gaussian" in refused.stderr


def test_photos_may_have_names_in_any_script(app: ServedApp, folder: Path) -> None:
    hold_out(app, MODEL, VIEWS)
    cameras = json.loads(app.service.storage.get(layout.model_file(MODEL, "cameras.json")))
    names = ["写真\u3000一.jpg", "🦊/ø.jpg"]
    for row, name in zip(cameras["cameras"], names, strict=True):
        row["name"] = name
    app.service.storage.put(layout.model_file(MODEL, "cameras.json"), json.dumps(cameras).encode())
    with Client(str(app.http.base_url)) as client:
        model = client.model(MODEL)
        assert [view.name for view in model.edit(box=RIGHT, preview=True).views] == names
        made = client.model(str(model.edit(box=RIGHT).model))
        assert [camera.name for camera in made.cameras()] == names
        for key in ("spz", "sog"):
            assert model.download_as(key, folder / f"model.{key}").stat().st_size > 100
    wait_for(lambda: not list((folder / "tmp").iterdir()), 20)
