"""Proves what `splatmill clean` asks of its arguments, and that it hands them to the worker's program.

What the program removes is proved in tests/worker/render_service/test_clean.py.
"""

from pathlib import Path

import pytest

from tests.support.command_line import invoke, spawn


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "give --capture, --box or --min-weight"),
        (["--capture", "absent"], "There is no folder absent"),
        (["--min-weight", "1", "-o", "out.splat"], "out.splat must end in one of"),
        (["--box", "0", "0", "0", "0", "1", "1"], "The box is empty"),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_runs(ball: Path, options: list[str], said: str) -> None:
    ran = invoke("clean", str(ball), *options)
    assert ran.exit_code != 0
    assert said in " ".join(ran.output.replace("│", " ").split())


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    ran = invoke("clean", str(tmp_path / "none.ply"), "--min-weight", "1")
    assert ran.exit_code == 2
    assert "There is no file" in ran.output


@pytest.mark.slow
def test_a_box_is_cut_out_of_a_file(ball: Path) -> None:
    out = ball.with_name("half.ply")
    process = spawn("clean", ball, "-o", out, "--box", "0", "-9", "-9", "9", "9", "9")
    stdout, stderr = process.communicate(timeout=120)
    assert (process.returncode, stderr) == (0, "")
    lines = stdout.splitlines()
    assert lines[1].startswith("outside the box")
    removed, left = (int(line.split()[-3]) for line in lines[1:3])
    assert removed > 100
    assert removed + left == 500
    assert lines[-1] == str(out)
    assert out.is_file()
