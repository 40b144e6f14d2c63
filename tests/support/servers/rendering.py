"""A real renderer beside a served app, and held-out photos of a model that are its own pictures."""

from __future__ import annotations

import io
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from splatmill.backplane.storage import layout
from splatmill.schema import CameraSpec, ModelCamera, ModelCameras
from tests.support.served_app import ServedApp
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
