"""The command line against the real server: what it prints, what it leaves, how it ends, and what Ctrl-C does.

Does not prove the embedded service, which tests/service starts; a worker's part is played through the backplane here.
"""

import asyncio
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.cli.app import COMMANDS
from splatmill.cli.commands.models.models import FILES, OPTIONAL_FILES
from splatmill.cli.display.follow import ONE_SIGNAL_SECONDS
from splatmill.cli.exits import Exit
from splatmill.schema import (
    JobState,
    LogEvent,
    PlanEvent,
    Problem,
    ProgressEvent,
    StateEvent,
    describe_options,
)
from splatmill.sdk.client import Client
from tests.client.cli.conftest import PLY
from tests.support.command_line import invoke, spawn
from tests.support.waiting import wait_for

PLAN = {
    "image_size": 480,
    "schedule": {"degree": 1},
    "reasons": {"image_size": "The photos resolve no more.", "degree": "The views span 20 degrees."},
    "left_out": {"exposure": "Exposures agree."},
}


def newest(service) -> str | None:
    with Client(service.url) as client:
        return next((job.id for job in client.jobs(limit=1)), None)


def work(service, ending: Callable[[str], None]) -> threading.Thread:
    """Play the worker for the next job, in the background."""

    def play() -> None:
        job_id = str(wait_for(lambda: newest(service)))
        service.begin(job_id)
        service.say(
            job_id,
            StateEvent(state=JobState.sfm),
            LogEvent(level="warning", message="2 photos were left out"),
            StateEvent(state=JobState.training),
            PlanEvent(plan=PLAN),
            ProgressEvent(
                stage="training", done=50, total=100, loss=0.25, psnr=21.5, gaussians=12345, eta=65
            ),
            ProgressEvent(
                stage="training", done=100, total=100, loss=0.125, psnr=26.5, gaussians=23456, eta=0
            ),
        )
        ending(job_id)

    thread = threading.Thread(target=play)
    thread.start()
    return thread


def test_every_command_has_help():
    listed = invoke("--help").stdout
    for name in COMMANDS:
        assert name in listed
        if name not in ("up", "doctor", "bench"):  # theirs is read by the program they start
            assert invoke(name, "--help").exit_code == 0


def test_the_options_of_train_are_those_of_the_schema():
    shown = " ".join(invoke("train", "--help").stdout.split())
    for option in describe_options():
        assert option.flag in shown
        assert option.help.split()[0] in shown
        if option.type == "integer":
            assert f"{option.minimum}<=x<={option.maximum}" in shown
        for choice in option.choices or []:
            assert choice in shown


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["--steps", "0"], Exit.usage, "greater than or equal to 1"),
        (["--steps", "many"], Exit.usage, "--steps"),
        (["--preset", "best"], Exit.usage, "best"),
        (["--time-budget", "soon"], Exit.usage, "'soon' is not a duration"),
        (["--max-memory", "1MB"], Exit.usage, "greater than or equal to 200000000"),
        (["--stepps", "3"], Exit.usage, "No such option"),
        (["--detach"], Exit.usage, "--detach needs --server"),
        (["--priority", "5"], Exit.usage, "--priority orders the jobs of a server"),
        (["--priority", "101"], Exit.usage, "less than or equal to 100"),
        (["--server", "nonsense"], Exit.usage, "address of a server"),
        (["--server", "http://127.0.0.1:9"], Exit.unreachable, "splatmill up"),
    ],
)
def test_wrong_arguments_of_train(photos: Path, tmp_path: Path, monkeypatch, arguments, code, sentence):
    monkeypatch.setattr("splatmill.transfer.connection.FIRST_PAUSE", 0.001)
    done = invoke("train", photos, "-o", tmp_path / "out", *arguments)
    assert done.exit_code == code, done.output
    assert sentence in " ".join(done.output.replace("│", " ").split())
    assert "Traceback" not in done.output


def test_a_path_with_nothing_to_train(tmp_path: Path):
    done = invoke("train", tmp_path)
    assert done.exit_code == Exit.refused
    assert "contains no photos" in done.stderr


def test_a_single_photo_is_refused_before_anything_starts(tmp_path: Path):
    (tmp_path / "a.jpg").write_bytes(b"x")
    for path in (tmp_path, tmp_path / "a.jpg"):
        done = invoke("train", path, "-o", tmp_path / "out")
        assert done.exit_code == Exit.refused
        assert "a.jpg is one photo; depth cannot be recovered" in done.stderr
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_train_on_a_server(service, photos: Path, tmp_path: Path):
    out = tmp_path / "out"
    worker = work(service, lambda job_id: service.finish(job_id, PLY))
    process = spawn("train", photos, "-o", out, "--server", service.url, "--steps", "100", "-v")
    stdout, stderr = process.communicate(timeout=60)
    worker.join()
    assert process.returncode == 0, stderr
    assert (out / "model.ply").read_bytes() == PLY
    assert json.loads((out / "report.json").read_text())["curve"][0]["psnr"] == 25
    assert {path.name for path in out.iterdir()} >= {"model.ply", "report.json", "report.png", "report.html"}
    for line in (
        "3 photos, 3.0 kB",
        "ignored: notes.txt",
        "recovering the cameras",
        "warning: 2 photos were left out",
        "plan: image size: 480 - The photos resolve no more.",
        "plan: degree - The views span 20 degrees.",
        "plan: without exposure - Exposures agree.",
        "training  50/100  loss 0.2500  PSNR 21.50 dB  12,345 Gaussians  ETA 1m05s",
        "training  100/100  loss 0.1250  PSNR 26.50 dB  23,456 Gaussians  ETA 0.0s",
        "1 Gaussians",
        str(out / "model.ply"),
    ):
        assert line in stdout
    assert "\x1b" not in stdout, "no control sequences where nobody watches a terminal"


@pytest.mark.slow
def test_train_on_a_terminal(service, photos: Path, tmp_path: Path):
    worker = work(service, lambda job_id: service.finish(job_id, PLY))
    ours, theirs = pty.openpty()
    arguments = ["train", photos, "-o", tmp_path / "out", "--server", service.url]
    process = spawn(*arguments, stdout=theirs, stderr=theirs, text=None)
    os.close(theirs)
    shown = b""
    try:
        while chunk := os.read(ours, 65536):
            shown += chunk
    except OSError:
        pass  # how Linux says that the other side of a terminal is closed
    os.close(ours)
    worker.join()
    assert process.wait() == 0, shown.decode()
    assert b"recovering the cameras" in shown
    assert b"model.ply" in shown


def test_a_failed_job(service, photos: Path, tmp_path: Path):
    facts = {"parallax_deg": 0.125, "left_out": [f"{n}.jpg" for n in range(12)]}
    problem = Problem.of("sfm_no_parallax", "The camera only turned.", facts=facts, advice="Walk around it.")
    worker = work(service, lambda job_id: service.fail(job_id, problem))
    process = spawn("train", photos, "-o", tmp_path / "out", "--server", service.url)
    _, stderr = process.communicate(timeout=60)
    worker.join()
    assert process.returncode == Exit.job_failed
    assert stderr.splitlines() == [
        "Error: The camera only turned.",
        "  parallax deg: 0.125",
        "  left out:",
        *(f"    {n}.jpg" for n in range(10)),
        "    and 2 more",
        "Walk around it.",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_cancels_the_job(service, photos: Path, tmp_path: Path, number: signal.Signals):
    process = spawn("train", photos, "-o", tmp_path / "out", "--server", service.url)
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    assert any("waiting for a worker" in line for line in lines)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == Exit.cancelled, stderr
    assert "Cancelling the job" in stdout
    assert "was cancelled." in stdout
    assert "Traceback" not in stderr
    with Client(service.url) as client:
        assert [job.state for job in client.jobs()] == [JobState.cancelled]


def test_a_detached_job_and_what_is_asked_about_it(service, photos: Path, tmp_path: Path):
    at = ("--server", service.url)
    assert "no jobs yet" in invoke("jobs", *at).output
    options = ("--detach", "--name", "tea", "--priority", "5")
    job_id = invoke("train", photos, "-o", tmp_path / "out", *options, *at).stdout.split()[-1]
    with Client(service.url) as client:
        assert client.job(job_id).job.priority == 5
    listed = invoke("jobs", *at).stdout
    assert job_id in listed
    assert "queued" in listed
    assert json.loads(invoke("jobs", "--json", *at).stdout)["name"] == "tea"

    service.begin(job_id)
    service.say(job_id, PlanEvent(plan=PLAN), ProgressEvent(stage="training", done=1, total=9, loss=0.5))
    status = invoke("status", job_id, *at).stdout
    for line in (
        "state     preparing",
        "progress  training  1/9  loss 0.5000",
        "image size: 480",
        "without exposure",
    ):
        assert line in status
    done = invoke("download", job_id, "-o", tmp_path / "model", *at)
    assert done.exit_code == Exit.not_found
    assert "not finished" in done.stderr

    service.finish(job_id, PLY)
    done = invoke("download", job_id, "-o", tmp_path / "model", *at)
    assert str(tmp_path / "model" / "model.ply") in done.stdout
    assert json.loads(invoke("status", job_id, "--json", *at).stdout)["state"] == "succeeded"
    done = invoke("cancel", job_id, *at)
    assert done.exit_code == Exit.not_found
    assert done.stderr.startswith("Error: ")


def test_cancel(service, photos: Path, tmp_path: Path):
    at = ("--server", service.url)
    job_id = invoke("train", photos, "-o", tmp_path / "out", "--detach", *at).stdout.split()[-1]
    assert invoke("cancel", job_id, *at).stdout == f"The job {job_id} is cancelled.\n"


def test_rendering_asks_the_server_as_it_should(service, photos: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("splatmill.transfer.connection.FIRST_PAUSE", 0.001)
    at = ("--server", service.url)
    job_id = invoke("train", photos, "-o", tmp_path / "out", "--detach", *at).stdout.split()[-1]
    service.begin(job_id)
    service.finish(job_id, PLY)
    picture = tmp_path / "view.png"
    done = invoke("render", job_id, "-o", picture, *at)
    assert (done.exit_code, picture.exists()) == (Exit.unreachable, False)
    assert "renderer" in done.stderr
    done = invoke("render", job_id, "--view", "b.jpg", *at)
    assert done.exit_code == Exit.usage
    assert "a.jpg" in done.output
    assert invoke("render", job_id, "-o", "view.bmp", *at).exit_code == Exit.usage
    camera = tmp_path / "camera.json"
    camera.write_text('{"width": 0}')
    done = invoke("render", job_id, "--camera", camera, *at)
    assert done.exit_code == Exit.refused
    assert "camera_to_world: Field required" in done.stderr
    assert "Traceback" not in done.output


def test_an_unknown_job(service):
    done = invoke("status", "0123456789abcdef", "--server", service.url)
    assert done.exit_code == Exit.not_found
    assert done.stderr.startswith("Error: There is no job '0123456789abcdef'.")


def test_the_options_are_listed():
    done = invoke("options")
    for option in describe_options():
        assert option.flag in done.stdout


def test_an_output_folder_that_cannot_be_written(photos: Path, tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    done = invoke("train", photos, "-o", tmp_path / "file" / "out", "--server", "http://127.0.0.1:9")
    assert done.exit_code == Exit.error
    assert str(tmp_path / "file") in done.stderr
    assert "Traceback" not in done.output


def test_starting_is_quick():
    code = "import sys; from splatmill.cli.app import app; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    # What takes time to load is loaded by the commands that need it.
    assert not {"pydantic", "httpx", "asyncio", "rich.progress"} & set(loaded)


@pytest.mark.slow
def test_a_second_interruption_does_not_wait(peer, reply, photos: Path, tmp_path: Path):
    job = {
        "id": "j1",
        "capture": "c1",
        "state": "queued",
        "options": {},
        "created_at": "2026-01-01T00:00:00Z",
    }
    capture = {"id": "c1", "created_at": "2026-01-01T00:00:00Z"}
    file = {"role": "images", "name": "a.jpg", "size": 1, "sha256": "0" * 64}

    async def answer(request):
        if request.path.endswith(("/events", "/cancel")):
            await asyncio.Event().wait()  # a server that hangs
        body = file if request.method == "PUT" else capture if request.path.endswith("/captures") else job
        return reply(status=201, body=json.dumps(body).encode())

    peer.answer = answer
    process = spawn("train", photos, "-o", tmp_path / "out", "--server", peer.url)
    wait_for(lambda: any(request.path.endswith("/events") for request in peer.requests))
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGTERM)  # timeout(1) signals the process and its group
    wait_for(lambda: any(request.path.endswith("/cancel") for request in peer.requests))
    assert process.poll() is None
    time.sleep(2 * ONE_SIGNAL_SECONDS)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == Exit.cancelled
    assert "Cancelling the job j1" in stdout
    assert stderr == "The job is being cancelled; this command does not wait for its end.\n"


def test_an_interruption_before_the_job_began(peer, reply, photos: Path, tmp_path: Path):
    async def hang(_):
        await asyncio.Event().wait()

    peer.answer = hang
    process = spawn("train", photos, "-o", tmp_path / "out", "--server", peer.url)
    wait_for(lambda: peer.requests)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert (process.returncode, stderr) == (Exit.cancelled, "Stopped.\n")


def test_every_file_of_a_model_is_written_but_its_record() -> None:
    assert {*FILES, *OPTIONAL_FILES} == layout.MODEL_FILES.keys() - {"job.json"}
