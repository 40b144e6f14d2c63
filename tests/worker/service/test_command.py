"""Proves which queues a worker serves, how it imports what attempts run, and that one that cannot start says why."""

import gc
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatmill_worker.service import command, served_lines
from splatmill_worker.service.served_lines import UnservedLines


@pytest.mark.parametrize(
    ("named", "absence", "served"),
    [
        (None, "", ("any", "cpu", "gpu")),
        (None, "No driver of a GPU is loaded.", ("any", "cpu")),
        ("", "no GPU", ("any", "cpu")),
        ("gpu", "", ("gpu",)),
        (" gpu, any,", "", ("any", "gpu")),
        ("cpu", "no GPU", ("cpu",)),
    ],
)
def test_a_worker_serves_what_it_is_told_or_what_it_can(
    monkeypatch: pytest.MonkeyPatch, named: str | None, absence: str, served: tuple[str, ...]
) -> None:
    monkeypatch.setattr(served_lines, "gpu_absence", lambda: absence)
    assert served_lines.served_lines(named) == served


def test_a_queue_that_cannot_be_served_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(served_lines, "gpu_absence", lambda: "The driver is too old.")
    with pytest.raises(UnservedLines, match=r"no queue rocket.*any, cpu, gpu"):
        served_lines.served_lines("gpu,rocket")
    monkeypatch.setenv("SPLATMILL_QUEUES", "gpu")
    assert command.serve(None) == 1
    assert "The driver is too old." in capsys.readouterr().err


@pytest.mark.parametrize(("kills", "absence"), [(2, "no GPU here"), (3, "ended by signal 9")])
def test_a_process_that_is_killed_while_it_looks_for_a_gpu_is_followed(
    kills: int, absence: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Else a worker would leave its GPU unused for as long as it runs."""
    asked = tmp_path / "asked"
    monkeypatch.setattr(served_lines, "_DEVICES", ("null",))
    monkeypatch.setattr(
        served_lines,
        "_ASK",
        f"import os, signal; file = open({str(asked)!r}, 'a'); file.write('x'); file.close()\n"
        f"if os.path.getsize({str(asked)!r}) <= {kills}: os.kill(os.getpid(), signal.SIGKILL)\n"
        "print('no GPU here')",
    )
    assert absence in served_lines.gpu_absence()
    assert asked.stat().st_size == 3


def test_no_garbage_is_collected_while_the_pipeline_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "made_pipeline.py").write_text("import gc\nenabled = gc.isenabled()\nrun = gc.isenabled\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("SPLATMILL_PIPELINE", "made_pipeline")
    here: list[object] = []
    run: object = command._pipeline()
    assert not importlib.import_module("made_pipeline").enabled
    assert run is gc.isenabled
    assert gc.isenabled()
    assert not any(each is here for each in gc.get_objects()), "it was not frozen"
    monkeypatch.setenv("SPLATMILL_PIPELINE", "no_such_pipeline")
    with pytest.raises(ModuleNotFoundError):
        command._pipeline()
    assert gc.isenabled()


@pytest.mark.slow
def test_a_worker_started_by_hand_says_that_redis_is_away(tmp_path: Path) -> None:
    environment = dict(os.environ) | {"REDIS_URL": f"unix://{tmp_path}/nothing.sock"}
    code = "import splatmill_worker.service.command as c; c.REDIS_WAIT = 0.1; raise SystemExit(c.serve(None))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "nothing.sock" in done.stderr
    assert "REDIS_URL" in done.stderr
