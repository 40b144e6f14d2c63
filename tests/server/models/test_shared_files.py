"""Proves that a link to a model gives out nothing that names the machine which trained it: no path, host or processor.

With a model of the real pipeline: every file, the figures of the link, its cameras, and what its addresses answer.
Does not prove what the photos themselves show, which are given out where they were held out.
"""

from __future__ import annotations

import getpass
import io
import platform
import zipfile
from pathlib import Path

import httpx
import pytest

from splatmill.backplane.jobs import row
from splatmill.schema import ProgressVideo, Switch, TrainOptions
from splatmill_worker import pipeline
from splatmill_worker.service.attempts.attempt import Attempt
from splatmill_worker.service.attempts.publish import publish
from splatmill_worker.service.lock import JobLock
from splatmill_worker.service.room import Room
from splatmill_worker.splat.machine import machine
from tests.support import still_life
from tests.support.served_app import Serve, problem

pytestmark = pytest.mark.slow


def secrets_of(work: Path) -> dict[str, bytes]:
    """What names this machine, by kind."""
    said = {
        "folder": str(work),
        "temporary folder": str(work.parent),
        "home": str(Path.home()) + "/",
        "host": platform.node(),
        "kernel": platform.release(),
        "processor": machine()["processor"],
        "user": f"/{getpass.getuser()}/",
    }
    return {kind: text.encode() for kind, text in said.items() if len(text) > 2}


def unpacked(content: bytes) -> bytes:
    """The content, and that of the files in it where it is a zip."""
    if not content.startswith(b"PK"):
        return content
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return content + b"".join(archive.read(name) for name in archive.namelist())


def test_a_link_gives_out_nothing_about_the_machine(serve: Serve, tmp_path: Path) -> None:
    app = serve(api_key="s3cret")
    work = tmp_path / "work"
    asked = TrainOptions(steps=40, max_gaussians=500, time_lapse=Switch.on, progress_video=ProgressVideo.view)
    outcome = pipeline.run(
        still_life.posed_capture(tmp_path / "capture"), work, asked, lambda _: None, lambda: False
    )
    job = app.job(steps=40)
    app.begin(job)
    job_row = row.read(app.redis, job)
    assert job_row is not None
    publish(
        app.service.storage,
        Attempt(app.redis, job, job_row.generation, 1, JobLock(app.redis, job, "token")),
        job_row,
        outcome.out,
        Room(app.redis, job_row.owner, job),
    )
    links = [
        app.http.post(f"/v1/models/{job}/shares", json={"photos": photos}).raise_for_status().json()["path"]
        for photos in (False, True)
    ]
    link = links[-1]
    with httpx.Client(base_url=app.http.base_url, timeout=60) as stranger:
        base = f"{link}/model"
        shown = stranger.get(base).raise_for_status()
        names = [file["name"] for file in shown.json()["files"]]
        assert {
            "model.ply",
            "report.html",
            "report.png",
            "cameras.zip",
            "progress.mp4",
            "time_lapse/000.ply",
        } <= {*names}
        assert any(name.startswith("held_out/") for name in names)
        answers = {name: stranger.get(f"{base}/files/{name}").raise_for_status() for name in names}
        answers |= {path: stranger.get(base + path) for path in ("", "/cameras", "/formats")} | {
            "page": stranger.get(link)
        }
        for kind, secret in secrets_of(work).items():
            for name, answer in answers.items():
                assert secret not in unpacked(answer.content), f"{name} names the {kind} of the machine"
                assert secret not in repr(answer.headers).encode(), f"the headers of {name} name the {kind}"
        for hidden in ("job.json", "frame.json", "report.json"):
            problem(stranger.get(f"{base}/files/{hidden}"), 404, "file_not_found")
        # A link without photos gives out the same files but for the photos and the report, which shows some.
        bare = f"{links[0]}/model"
        left = {*names} - {file["name"] for file in stranger.get(bare).json()["files"]}
        assert left == {"report.html"} | {name for name in names if name.startswith("held_out/")}
        for name in left:
            problem(stranger.get(f"{bare}/files/{name}"), 404, "file_not_found")
        assert [
            camera["photo"]
            for camera in stranger.get(f"{base}/cameras").json()["cameras"]
            if "photo" in camera
        ]
        assert not any(camera.get("photo") for camera in stranger.get(f"{bare}/cameras").json()["cameras"])
    own = app.http.get(f"/v1/jobs/{job}/report").raise_for_status().text
    for kind, secret in secrets_of(work).items():
        assert secret.decode() not in own or kind == "processor", (
            f"the report names the {kind} of the machine"
        )
