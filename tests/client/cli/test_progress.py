"""Lines of progress for logs: a few per stage, the last numbers of each always, and all in the order they happened.

Does not prove how the moving line on a terminal looks.
"""

import time

import pytest

from splatmill.cli.display import progress as cli
from splatmill.schema import Progress


def step(n: int, stage: str = "training") -> Progress:
    return Progress(stage=stage, done=n, total=1000, step=n)


def test_many_steps_are_few_lines_and_the_last_is_never_lost(capsys: pytest.CaptureFixture[str]):
    with cli.PlainDisplay() as display:
        for n in range(1, 1001):
            display.progress(step(n))
        display.print("writing the model")
        for n in range(5):
            display.progress(step(n, "files"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "training  1/1000"
    assert lines[lines.index("writing the model") - 1] == "training  1000/1000"
    assert lines[-1] == "files  4/1000"
    assert len(lines) < 20


def test_a_stage_is_told_at_once_and_again_after_a_while(capsys: pytest.CaptureFixture[str]):
    with cli.PlainDisplay(interval=0.0) as display:
        for n in range(4):
            display.progress(step(n))
            display.progress(step(n))
    assert len(capsys.readouterr().out.splitlines()) == 4  # the same progress is not printed again


def test_the_last_progress_before_a_pause_is_printed_during_it(capsys: pytest.CaptureFixture[str]):
    with cli.PlainDisplay(interval=0.2) as display:
        for n in range(1, 5):
            display.progress(step(n))
        lines = capsys.readouterr().out.splitlines()
        began = time.monotonic()
        while lines[-1] != "training  4/1000" and time.monotonic() < began + 30.0:
            time.sleep(0.02)
            lines += capsys.readouterr().out.splitlines()
        assert (lines[0], lines[-1]) == ("training  1/1000", "training  4/1000")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("progress", "text"),
    [
        (Progress(stage="mapping", done=3, total=9, note="photos placed"), "mapping  3/9  photos placed"),
        (Progress(stage="uploading", done=1500, total=2_000_000), "uploading  1.5 kB/2.0 MB"),
        (Progress(stage="matching", done=7), "matching  7"),
        (Progress(stage="waiting"), "waiting"),
        (
            Progress(stage="training", done=3, total=9, at_most=True, note="coarse model"),
            "training  3/9  or fewer, where more gain too little  coarse model",
        ),
        (Progress(stage="training", loss=0.5, eta=-1.0), "training  loss 0.5000  ETA 0.0s"),
    ],
)
def test_lines(progress: Progress, text: str):
    assert cli.progress_text(progress) == text
