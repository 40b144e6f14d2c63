"""The commands that list, show, follow and delete what a real server stores, and what they print on a terminal.

A worker's part is played through the backplane. Does not prove what trains, nor the embedded service.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from splatmill.backplane.storage import layout
from splatmill.cli.exits import Exit
from splatmill.schema import EventRecord, JobState, LogEvent, Problem, ProgressEvent, StateEvent
from splatmill.sdk.client import Client
from tests.client.cli.conftest import PLY
from tests.support.command_line import invoke, on_terminal, spawn

LONG = "the kitchen of the old house by the lake, second floor, at noon"


@pytest.fixture
def at(service) -> tuple[str, str]:
    return ("--server", service.url)


@pytest.fixture
def jobs(service, photos) -> list[str]:
    """Three jobs on one capture: succeeded, training, queued."""
    with Client(service.url) as client:
        capture, _ = client.upload(photos, name="kitchen photos")
        made = [client.submit(capture.id, name=name).id for name in (LONG, "garden", "[red]")]
    service.begin(made[0])
    service.finish(made[0], PLY)
    service.begin(made[1])
    service.say(
        made[1],
        StateEvent(state=JobState.training),
        LogEvent(level="warning", message="2 photos were left out"),
        LogEvent(level="warning", message="step\x1b[2J 1"),
        ProgressEvent(stage="training", done=450, total=1000, loss=0.25, psnr=21.5, gaussians=12345, eta=65),
    )
    return made


def capture_of(at, job_id: str) -> str:
    return str(json.loads(invoke("status", job_id, "--json", *at).stdout)["capture"])


def test_lists_are_narrowed_by_options(at, jobs):
    def listed(*options: str) -> list[str]:
        printed = invoke("jobs", "--json", *options, *at).stdout
        return [json.loads(line)["id"] for line in printed.splitlines()]

    assert listed() == jobs[::-1]
    assert listed("--state", "training") == [jobs[1]]
    assert listed("--state", "training", "--state", "succeeded") == jobs[1::-1]
    assert listed("--name", "KITCHEN") == [jobs[0]]
    assert listed("--capture", capture_of(at, jobs[0])) == jobs[::-1]
    assert listed("--capture", "0" * 16) == []
    assert listed("--owner", "default") == jobs[::-1]
    assert listed("--owner", "nobody") == []
    for command in ("captures", "models"):
        assert invoke(command, "--json", "--owner", "default", *at).stdout
        assert not invoke(command, "--json", "--owner", "nobody", *at).stdout
    assert listed("--sort", "name") == [jobs[2], jobs[1], jobs[0]]
    assert listed("--sort", "psnr")[0] == listed("--sort", "size")[0] == jobs[0], "the only one with a model"
    assert invoke("jobs", "--sort", "colour", *at).exit_code == Exit.usage
    assert invoke("models", "--sort", "colour", *at).exit_code == Exit.usage
    assert invoke("jobs", "--name", "none such", *at).stdout == "No job matches.\n"
    assert invoke("jobs", "--state", "sleeping", *at).exit_code == Exit.usage


def test_captures_and_models_are_listed_and_shown(at, jobs):
    capture = capture_of(at, jobs[0])
    assert json.loads(invoke("captures", "--json", *at).stdout)["id"] == capture
    shown = invoke("captures", capture, *at).stdout
    for line in (f"capture   {capture}", "name      kitchen photos", "files     3, 3.0 kB", "images  2.jpg"):
        assert line in shown
    assert len(json.loads(invoke("captures", capture, "--json", *at).stdout)["files"]) == 3
    assert json.loads(invoke("models", "--json", "--name", "lake", *at).stdout)["id"] == jobs[0]
    shown = invoke("models", jobs[0], *at).stdout
    for line in (f"model     {jobs[0]}", "Gaussians 1, spherical", "held out  PSNR 25.00 dB", "model.ply"):
        assert line in shown
    assert json.loads(invoke("models", jobs[0], "--json", *at).stdout)["gaussians"] == 1
    assert invoke("models", "--name", "garden", *at).stdout == "No model matches.\n"
    assert invoke("captures", "--name", "garden", *at).stdout == "No capture matches.\n"
    assert invoke("models", jobs[1], *at).exit_code == Exit.not_found
    assert invoke("captures", "0" * 16, *at).exit_code == Exit.not_found


def test_tables_fit_a_terminal_of_80_columns_and_are_whole_elsewhere(at, jobs):
    _, shown = on_terminal("jobs", *at)
    lines = shown.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) == 4, "one line for each job"
    for job_id in jobs:
        assert job_id in shown
    assert "training 45%" in shown
    assert "…" in shown
    assert "[red]" in shown, "names are not markup"
    assert LONG in invoke("jobs", *at).stdout


def test_the_log(service, at, jobs):
    printed = invoke("logs", jobs[1], *at).stdout.splitlines()
    assert [line[21:] for line in printed] == [
        "warning  2 photos were left out",
        "warning  step\N{REPLACEMENT CHARACTER}[2J 1",
    ]
    assert len(invoke("logs", jobs[1], "-n", "1", *at).stdout.splitlines()) == 1
    lines = [json.loads(line) for line in invoke("logs", jobs[1], "--json", *at).stdout.splitlines()]
    assert [line["message"] for line in lines] == ["2 photos were left out", "step\x1b[2J 1"]
    assert invoke("logs", "0" * 16, *at).exit_code == Exit.not_found


def test_the_log_is_followed_to_the_end_of_the_job(service, at, jobs):
    process = spawn("logs", jobs[1], "--follow", "-n", "1", *at)
    assert process.stdout is not None
    assert "step" in process.stdout.readline(), "the lines before the last one are not shown"
    service.say(jobs[1], LogEvent(message="another line"))
    assert "another line" in process.stdout.readline()
    service.finish(jobs[1], PLY)
    rest, stderr = process.communicate(timeout=30)
    assert (process.returncode, rest, stderr) == (0, "", "")


def test_following_a_job_to_its_model(service, at, jobs, tmp_path: Path):
    threading.Timer(0.3, service.finish, [jobs[1], PLY]).start()
    done = invoke("follow", jobs[1], "-o", tmp_path / "out", *at)
    assert done.exit_code == 0, done.output
    for line in ("warning: 2 photos were left out", "training  450/1000", "1 Gaussians", "model.ply"):
        assert line in done.stdout
    assert (tmp_path / "out" / "model.ply").read_bytes() == PLY
    printed = invoke("follow", jobs[1], "--json", *at).stdout.splitlines()
    types = [EventRecord.model_validate_json(line).event.type for line in printed]
    assert sorted(types) == ["log", "log", "progress", *4 * ["state"]]


def test_following_a_job_that_fails_or_is_cancelled(service, at, jobs):
    service.fail(jobs[1], Problem.of("diverged", "It diverged.", advice="Take fewer steps."))
    done = invoke("follow", jobs[1], *at)
    assert done.exit_code == Exit.job_failed
    assert done.stderr == "Error: It diverged.\nTake fewer steps.\n"
    assert invoke("cancel", jobs[2], *at).exit_code == 0
    done = invoke("follow", jobs[2], *at)
    assert done.exit_code == Exit.cancelled
    assert "was cancelled." in done.stdout


def test_ctrl_c_ends_the_following_and_not_the_job(service, at, jobs):
    process = spawn("follow", jobs[1], *at)
    assert process.stdout is not None
    assert any("training  450/1000" in line for line in iter(process.stdout.readline, ""))
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == Exit.cancelled
    assert stderr == f"The job continues. See how it gets on: splatmill follow {jobs[1]}\n"
    assert json.loads(invoke("status", jobs[1], "--json", *at).stdout)["state"] == "training"


def test_restarting(service, at, jobs):
    done = invoke("restart", jobs[1], *at)
    assert done.exit_code == Exit.not_found
    assert "has not ended" in done.stderr
    service.fail(jobs[1], Problem.of("diverged", "It diverged."))
    done = invoke("restart", jobs[1], *at)
    assert done.stdout.startswith(f"The job {jobs[1]} is queued.")


def test_deleting(service, at, jobs):
    capture = capture_of(at, jobs[0])
    done = invoke("delete", jobs[0], *at)
    assert done.exit_code == Exit.usage
    assert "give --yes" in done.output
    done = invoke("delete", jobs[0], jobs[1], "--yes", *at)
    assert done.exit_code == Exit.not_found
    assert f"Cancel it first: splatmill cancel {jobs[1]}" in done.stderr
    done = invoke("delete", jobs[0], "0" * 16, "--yes", *at)
    assert done.exit_code == Exit.not_found
    assert "There is no job, model or capture" in done.stderr
    assert invoke("status", jobs[0], *at).exit_code == 0, "a wrong id deletes nothing"
    done = invoke("delete", capture, "--yes", *at)
    assert done.exit_code == Exit.not_found
    assert "has not ended" in done.stderr

    done = invoke("delete", jobs[0], "--yes", *at)
    assert done.stdout == (
        f"Deleted the job {jobs[0]} ({LONG}, succeeded) and its model of 1 Gaussians, {len(PLY)} B.\n"
    )
    assert invoke("models", jobs[0], *at).exit_code == Exit.not_found
    for job_id in jobs[1:]:
        invoke("cancel", job_id, *at)
        service.say(job_id, StateEvent(state=JobState.cancelled))
    done = invoke("delete", *jobs[1:], capture, "-y", *at)
    assert done.exit_code == 0, done.output
    assert f"Deleted the capture {capture} (kitchen photos, 3 files, 3.0 kB)." in done.stdout
    assert invoke("captures", *at).stdout == "No capture is stored.\n"


def test_deleting_asks_on_a_terminal(at, jobs):
    status, shown = on_terminal("delete", jobs[0], *at, typed="n\n")
    assert status == 1
    assert "Delete this for good? [y/N]" in shown
    assert "Nothing was deleted." in shown
    status, shown = on_terminal("delete", jobs[0], *at, typed="y\n")
    assert status == 0
    assert f"Deleted the job {jobs[0]}" in shown
    assert invoke("status", jobs[0], *at).exit_code == Exit.not_found


def test_renaming(at, jobs):
    assert invoke("rename", jobs[0], "Vase 🌷", *at).stdout == f"The job {jobs[0]} is named Vase 🌷.\n"
    assert json.loads(invoke("models", jobs[0], "--json", *at).stdout)["name"] == "Vase 🌷"
    assert invoke("rename", jobs[0], "", *at).stdout == f"The job {jobs[0]} has no name.\n"
    assert invoke("rename", jobs[0], "x" * 201, *at).exit_code != 0
    assert invoke("rename", "0" * 16, "x", *at).exit_code == Exit.not_found


def test_tags_and_stars_are_given_and_lists_are_narrowed_by_them(at, jobs):
    def listed(command: str, *options: str) -> list[str]:
        printed = invoke(command, "--json", *options, *at).stdout
        return [json.loads(line)["id"] for line in printed.splitlines()]

    result = invoke("label", jobs[0], "--tags", " Garden , drone,", "--favourite", *at)
    assert result.stdout == f"The job {jobs[0]} is tagged Garden, drone, with a star.\n"
    assert invoke("label", jobs[1], "--tags", "drone", *at).stdout == f"The job {jobs[1]} is tagged drone.\n"
    assert listed("jobs", "--tag", "DRONE") == jobs[1::-1]
    assert listed("jobs", "--tag", "garden") == listed("jobs", "--favourite") == [jobs[0]]
    assert listed("jobs", "--no-favourite") == jobs[:0:-1]
    assert listed("models", "--tag", "drone") == listed("models", "--favourite") == [jobs[0]]
    for command in ("models", "status"):
        shown = invoke(command, jobs[0], *at).stdout
        assert "tags      Garden, drone\n" in shown
        assert "favourite yes\n" in shown
    # What is not named stays as it is.
    assert "tagged Garden, drone." in invoke("label", jobs[0], "--no-favourite", *at).stdout
    assert invoke("label", jobs[0], "--tags", "", *at).stdout == f"The job {jobs[0]} is without tags.\n"
    for command in ("models", "jobs"):
        assert "matches." in invoke(command, "--tag", "garden", *at).stdout
        assert "matches." in invoke(command, "--favourite", *at).stdout
    assert invoke("label", jobs[0], *at).exit_code == Exit.usage
    assert invoke("label", jobs[0], "--tags", "x" * 41, *at).exit_code != 0
    assert invoke("label", "0" * 16, "--favourite", *at).exit_code == Exit.not_found


def test_the_bin(service, at, jobs):
    capture = capture_of(at, jobs[0])
    assert invoke("bin", "list", *at).stdout == "The bin is empty.\n"
    done = invoke("bin", "put", jobs[1], *at)
    assert "has not ended" in done.stderr
    for job_id in jobs[1:]:
        invoke("cancel", job_id, *at)
        service.say(job_id, StateEvent(state=JobState.cancelled))
    done = invoke("bin", "put", jobs[0], capture, *at)
    assert done.exit_code == 0, done.output
    assert f"The job {jobs[0]} ({LONG}) is in the bin until" in done.stdout
    assert f"The capture {capture} (kitchen photos) is in the bin until" in done.stdout
    entries = [json.loads(line) for line in invoke("bin", "list", "--json", *at).stdout.splitlines()]
    assert [(entry["kind"], entry["id"]) for entry in entries] == [("capture", capture), ("job", jobs[0])]
    assert "kitchen photos" in invoke("bin", "list", *at).stdout
    assert invoke("models", *at).stdout == "No model is finished.\n"
    assert (
        invoke("bin", "restore", jobs[0], capture, *at).stdout
        == f"Restored {jobs[0]}.\nRestored {capture}.\n"
    )
    assert jobs[0] in invoke("models", *at).stdout
    done = invoke("bin", "restore", capture, *at)
    assert done.exit_code == Exit.not_found
    assert "is not in the bin" in done.stderr


def test_a_download_shows_a_bar_and_resumes(service, at, jobs, tmp_path: Path):
    model = PLY + bytes(3_000_000)
    service.storage.put(layout.model_file(jobs[0], "model.ply"), model)
    with Client(service.url) as client:
        part = tmp_path / "splat" / "model.ply.part"
        part.parent.mkdir()
        etag = client._async.connection.http.head  # the ETag that the server gives the file
        response = client._loop.run(etag(f"/v1/models/{jobs[0]}/files/model.ply"))
    part.write_bytes(model[:1_000_000])
    part.with_name("model.ply.part.etag").write_text(response.headers["ETag"])
    status, shown = on_terminal("download", jobs[0], "-o", tmp_path / "splat", "--file", "model.ply", *at)
    assert status == 0, shown
    assert "model.ply" in shown
    assert "1.0/3.0 MB" in shown or "3.0/3.0 MB" in shown
    assert (tmp_path / "splat" / "model.ply").read_bytes() == model
    assert [path.name for path in (tmp_path / "splat").iterdir()] == ["model.ply"]
    done = invoke("download", jobs[0], "-o", tmp_path, "--file", "none.txt", *at)
    assert done.exit_code == Exit.not_found
    assert "The files of a model are" in done.stderr


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["rest"], {"restart"}),
        (["train", "--preset", ""], {"draft", "balanced", "quality"}),
        (["jobs", "--state", "f"], {"failed"}),
        (["train", "--time-b"], {"--time-budget"}),
        (["download", "--file", "rep"], {"report.json", "report.png", "report.html"}),
    ],
)
def test_a_shell_completes_commands_options_and_values(words: list[str], offered: set[str]):
    command = ["splatmill", *words]
    asked = {"_SPLATMILL_COMPLETE": "complete_bash", "COMP_CWORD": str(len(words))}
    asked["COMP_WORDS"] = " ".join(command)
    program = Path(sys.executable).with_name("splatmill")
    done = subprocess.run([program], env=os.environ | asked, capture_output=True, text=True, timeout=60)
    assert set(done.stdout.split()) == offered


def test_status_says_where_a_waiting_job_stands(service, at, photos):
    with Client(service.url) as client:
        capture, _ = client.upload(photos)
        usual = client.submit(capture.id)
        urgent = client.submit(capture.id, priority=5)
        assert (usual.job.priority, usual.refresh().queue_position) == (0, 1)
        assert (urgent.job.priority, urgent.job.queue_position) == (5, 0)
    assert "next; no worker serves the queue 'any'" in invoke("status", urgent.id, *at).stdout
    assert "1 job before it" in invoke("status", usual.id, *at).stdout
    service.begin(usual.id)
    assert "before it" not in invoke("status", usual.id, *at).stdout


@pytest.mark.parametrize("group", ["keys", "webhooks", "shares", "bin"])
def test_a_group_of_commands_offers_no_completion_of_its_own(group):
    assert "--show-completion" not in invoke(group, "--help").stdout
