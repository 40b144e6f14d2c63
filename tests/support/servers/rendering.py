"""A real renderer beside a served app: the ball as its model, held-out photos of it that are its own pictures, and what
is made of it in the background. tests/server/conftest.py offers `folder` and `renderer` as fixtures."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from splatmill.backplane.storage import layout
from splatmill.schema import CameraSpec, ModelCamera, ModelCameras
from tests.support.ball import write_ply
from tests.support.served_app import Serve, ServedApp, store_model
from tests.support.waiting import wait_for


@contextmanager
def renderer_in(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the renderer on the socket `r.sock` of a folder, over the models of its `storage`."""
    path = folder / "r.sock"
    (folder / "tmp").mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "splatmill_worker", "renderer", "--uds", str(path)],
        env=dict(os.environ)
        | {
            "SPLATMILL_STORAGE": str(folder / "storage"),
            "TMPDIR": str(folder / "tmp"),
            "OMP_NUM_THREADS": "1",
        },
    )

    def listens() -> bool:
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(str(path)) == 0

    wait_for(listens)
    yield process
    process.terminate()
    process.wait(20)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `renderer`, with the storage of all apps of a file."""
    return tmp_path_factory.mktemp("rendered")


@pytest.fixture(scope="module")
def renderer(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """One renderer for all tests of a file."""
    with renderer_in(folder) as process:
        yield process


def serve_in(serve: Serve, folder: Path, **settings: Any) -> ServedApp:
    """An app over the storage of a folder, beside the renderer there."""
    defaults = {"renderer_url": f"unix:{folder}/r.sock", "storage": str(folder / "storage")}
    return serve(**(defaults | settings))


def store_only_ball(
    app: ServedApp, folder: Path, model_id: str, name: str | None = None, count: int = 400
) -> None:
    """The ball as a whole model, with a record, and nothing else that a test before left in storage."""
    for prefix in ("models", "captures", "jobs", "orbits", "meshes", "shares"):
        app.service.storage.delete_prefix(prefix)
    store_model(app.service, model_id, name)
    write_ply(folder / "model.ply", count)
    app.service.storage.put(layout.model_file(model_id, "model.ply"), folder / "model.ply")


@dataclass(frozen=True)
class KeptFiles:
    """Orbit videos or meshes of a model, made in the background: asked for over HTTP, and looked up in storage."""

    kind: layout.KeptKind
    model: str
    request: dict[str, Any]

    @property
    def path(self) -> str:
        return f"/v1/models/{self.model}/{self.kind}"

    def begun(self, app: ServedApp, **changed: Any) -> dict[str, Any]:
        """One that was asked for and is not there yet."""
        answer = app.http.post(self.path, json=self.request | changed)
        assert answer.status_code == 202, answer.text
        record: dict[str, Any] = answer.json()
        assert answer.headers["location"] == f"{self.path}/{record['id']}" == record["links"]["self"]
        return record

    def ended(self, app: ServedApp, kept_id: str) -> dict[str, Any]:
        """One that has succeeded or failed, once no mark is left."""
        address = f"{self.path}/{kept_id}"
        wait_for(lambda: app.http.get(address).json()["state"] in ("succeeded", "failed"), 200)
        wait_for(lambda: self.marks(app) == [])
        record: dict[str, Any] = app.http.get(address).json()
        return record

    def marks(self, app: ServedApp) -> list[str]:
        """The marks of those that have not ended."""
        return [entry.path for entry in app.service.storage.entries(layout.unfinished_kept(self.kind))]

    def files(self, app: ServedApp) -> list[str]:
        """What is stored, below the folder of the model's own."""
        folder = layout.kept_of(self.model, self.kind) + "/"
        return [entry.path.removeprefix(folder) for entry in app.service.storage.entries(folder)]


def hold_out(app: ServedApp, model_id: str, views: Sequence[CameraSpec]) -> None:
    """Photos of a model, as a worker keeps them, with one half of the first left out of the comparison."""
    cameras = []
    for index, view in enumerate(views):
        wish = {"camera": view.model_dump(mode="json", exclude_none=True)}
        answer = app.http.post(f"/v1/models/{model_id}/render", json=wish)
        picture, stream = Image.open(io.BytesIO(answer.content)).convert("RGBA"), io.BytesIO()
        if index == 0:
            picture.paste((255, 0, 255, 0), (0, 0, picture.width // 2, picture.height))
        picture.save(stream, "WEBP", lossless=True, exact=True)
        name = f"held_out/{index:03d}.webp"
        app.service.storage.put(layout.model_file(model_id, name), stream.getvalue())
        cameras.append(ModelCamera(name=f"{index}.jpg", split="test", camera=view, photo=name, psnr=50.0))
    stored = ModelCameras(cameras=cameras).model_dump_json().encode()
    app.service.storage.put(layout.model_file(model_id, "cameras.json"), stored)
