"""`splatmill train` without a server: an interrupted training is kept, and the same command continues it.

The pipeline is a stand-in, except in the last test, which recovers cameras and trains.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from splatmill.cli.display.follow import ONE_SIGNAL_SECONDS
from splatmill.cli.exits import Exit
from splatmill.cli.local.unfinished import Unfinished
from splatmill.errors import ServiceFailed
from splatmill.schema import TrainOptions
from splatmill.transfer.local_capture import find_files
from splatmill_worker.synthetic import capture
from tests.support.up import STANDIN
from tests.support.waiting import wait_for


class Command:
    """`splatmill train PHOTOS -o OUT`, as often as a test wants."""

    def __init__(self, folder: Path, **script: Any) -> None:
        self.photos = folder / "photos"
        self.photos.mkdir()
        for n in range(3):
            (self.photos / f"{n}.jpg").write_text(f"photo {n}")
        self.out = folder / "out"
        self.data = self.out / ".splatmill"
        self._diary = folder / "diary"
        self.script = {"steps": 60, "pause": 0.05, "diary": str(self._diary)} | script

    def start(self, *options: str, photos: Path | None = None) -> subprocess.Popen[str]:
        environment = os.environ | STANDIN | {"STANDIN_SCRIPT": json.dumps(self.script)}
        environment |= {"NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}
        environment.pop("SPLATMILL_SERVER", None)
        command = [
            sys.executable,
            "-m",
            "splatmill",
            "train",
            str(photos or self.photos),
            "-o",
            str(self.out),
        ]
        return subprocess.Popen(
            [*command, *options], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def run(self, *options: str, photos: Path | None = None) -> tuple[int, str]:
        """Return the exit code and all output."""
        process = self.start(*options, photos=photos)
        said, _ = process.communicate(timeout=120)
        return process.returncode, said

    def interrupted(self, sent: signal.Signals, options: tuple[str, ...] = ()) -> tuple[int, str]:
        """Start, send a signal once a new job has stored some steps, and return as `run` does."""
        known, _ = self.steps()
        process = self.start(*options)

        def trained() -> bool:
            job, step = self.steps()
            return job != known and step >= 5

        wait_for(trained, 150)
        process.send_signal(sent)
        said, _ = process.communicate(timeout=120)
        return process.returncode, said

    def diary(self) -> list[Any]:
        """What each attempt wrote when it began."""
        return (
            [json.loads(line) for line in self._diary.read_text().splitlines()]
            if self._diary.exists()
            else []
        )

    def jobs(self) -> list[Any]:
        """The trainings on record."""
        return list(json.loads((self.data / "training.json").read_text())["trainings"])

    def steps(self) -> tuple[str, int]:
        """The job that was recorded last, and its stored steps."""
        if not (self.data / "training.json").is_file():
            return "", 0
        job = self.jobs()[-1]["job"]
        stored = self.data / "work" / job / "run/checkpoints/state.json"
        return job, json.loads(stored.read_text())["step"] if stored.is_file() else 0


@pytest.fixture
def command(tmp_path: Path) -> Command:
    return Command(tmp_path)


def kept(command: Command, said: str) -> None:
    """Check that a command which was stopped says that the training is kept."""
    assert f"The training is kept in {command.data} (" in said
    assert "The same command continues" in said


@pytest.mark.slow
def test_only_the_same_command_goes_on_and_a_second_ctrl_c_loses_only_what_follows_the_last_checkpoint(
    tmp_path: Path,
) -> None:
    """A second command is refused while the first one runs, and one with other photos is refused after it."""
    # The step after the fifth is one call of native code, which cannot save its state.
    command = Command(tmp_path, do="native", at=6)
    with command.start() as process:
        wait_for(lambda: command.steps()[1] == 5, 60)
        code, said = command.run()
        assert code == Exit.no_service
        assert f"Another `splatmill train` (process {process.pid}) is writing to {command.out}" in said
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        said = ""
        while "A second Ctrl-C stops it at once" not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        time.sleep(2 * ONE_SIGNAL_SECONDS)  # two signals that come closer are one Ctrl-C
        process.send_signal(signal.SIGINT)
        said += process.stdout.read()
    assert process.returncode == Exit.cancelled, said
    command.script["do"] = "nothing"
    other = tmp_path / "other"
    other.mkdir()
    for n in range(3):
        (other / f"{n}.jpg").write_text(f"photo {n}")
    code, said = command.run(photos=other)
    assert code == Exit.no_service
    assert f"{command.data} holds an unfinished training of other photos, {command.photos}" in said
    assert "--fresh" in said
    code, said = command.run()
    assert code == 0, said
    assert "going on with the training that was stopped" in said
    assert [attempt["from"] for attempt in command.diary()] == [0, 5]
    assert (command.out / "model.ply").is_file()
    assert not command.data.exists()
    assert not (command.out / ".splatmill.lock").exists()


@pytest.mark.slow
def test_other_options_train_on_the_same_capture_and_the_first_ones_go_on_later(command: Command) -> None:
    """The first command is killed, the second one stopped."""
    code, _ = command.interrupted(signal.SIGKILL, options=("--seed", "1"))
    assert code == -signal.SIGKILL
    code, said = command.interrupted(signal.SIGTERM, options=("--seed", "2"))
    assert code == Exit.cancelled, said
    kept(command, said)
    one, two = command.jobs()
    local = {"time_lapse": "off"}
    assert (one["options"], two["options"]) == (local | {"seed": 1}, local | {"seed": 2})
    assert one["capture"] == two["capture"]
    assert one["job"] != two["job"]
    code, said = command.run("--seed", "1")
    assert code == 0, said
    assert command.diary()[-1]["from"] >= 5
    assert not any(attempt["overlap"] for attempt in command.diary())
    assert not command.data.exists()


@pytest.mark.slow
def test_added_photos_join_the_capture_changed_ones_begin_another_and_fresh_starts_over(
    command: Command,
) -> None:
    command.interrupted(signal.SIGINT)
    (command.photos / "3.jpg").write_text("photo 3")
    command.interrupted(signal.SIGINT)
    (command.photos / "0.jpg").write_text("another photo 0")
    command.interrupted(signal.SIGINT)
    first, added, changed = (training["capture"] for training in command.jobs())
    assert first == added != changed
    begun = len(command.diary())
    code, said = command.run("--fresh")
    assert code == 0, said
    assert "going on" not in said
    assert [attempt["from"] for attempt in command.diary()[begun:]] == [0]


def test_a_record_of_a_later_version_is_refused_and_kept(tmp_path: Path) -> None:
    data = tmp_path / ".splatmill"
    data.mkdir()
    (data / "training.json").write_text('{"format": 2}')
    (tmp_path / "0.jpg").write_text("photo")
    files = find_files(tmp_path).files
    with pytest.raises(ServiceFailed, match=r"training\.json: it has format 2"):
        Unfinished.open(data, tmp_path, files, TrainOptions(), fresh=False)
    assert (data / "training.json").is_file()
    assert Unfinished.open(data, tmp_path, files, TrainOptions(), fresh=True).trainings == []
    assert list(data.iterdir()) == []


def test_a_folder_without_a_record_is_emptied(tmp_path: Path) -> None:
    data = tmp_path / ".splatmill"
    (data / "storage").mkdir(parents=True)
    (tmp_path / "0.jpg").write_text("photo")
    Unfinished.open(data, tmp_path, find_files(tmp_path).files, TrainOptions(), fresh=False)
    assert list(data.iterdir()) == []


@pytest.mark.slow
def test_a_real_training_goes_on_at_its_checkpoint_with_its_cameras(tmp_path: Path) -> None:
    photos, out = tmp_path / "photos", tmp_path / "out"
    capture(photos, 16, 192, 144, samples=1)
    command = [
        sys.executable,
        "-m",
        "splatmill",
        "train",
        str(photos),
        "-o",
        str(out),
        "--image-size",
        "120",
        "--time-budget",
        "4s",
    ]
    environment = os.environ | {"NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "env": environment}
    with subprocess.Popen(command, **pipes) as first:
        assert first.stdout is not None
        lines = []
        for line in first.stdout:
            lines.append(line)
            if _step(line) > 0:
                first.send_signal(signal.SIGINT)
                break
        lines += list(first.stdout)
    said = "".join(lines)
    assert first.returncode == Exit.cancelled, said
    assert "matching" in said
    done = subprocess.run([*command, "--mesh"], **pipes, timeout=300)
    assert done.returncode == 0, done.stdout
    assert "matching" not in done.stdout
    assert "mapping" not in done.stdout
    steps = [step for line in done.stdout.splitlines() if (step := _step(line)) > 0]
    assert steps[0] >= max(_step(line) for line in lines)
    assert (out / "model.ply").is_file()
    assert (out / "mesh.glb").read_bytes().startswith(b"glTF")


def _step(line: str) -> int:
    """The step in a line of progress, or 0."""
    match = re.match(r"training  (\d+)/", line)
    return int(match[1]) if match else 0
