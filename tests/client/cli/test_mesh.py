"""Proves what `splatmill mesh` asks of its arguments, and that it hands them to the worker's program.

What the program makes is proved in tests/worker/render_service/test_mesh.py, and meshes of models on a server in
tests/server/background/test_meshes.py.
"""

from pathlib import Path

import pytest

from tests.support.command_line import invoke, spawn


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-o", "out.obj"], "out.obj must end in one of .glb, .ply"),
        (["--cameras", "absent.json"], "There is no file absent.json"),
        (["--box", "0", "0", "0", "0", "1", "1"], "The box is empty"),
        (["--faces", "3"], "Invalid value for '--faces'"),
        (["--voxel", "0"], "Invalid value for '--voxel'"),
        (["--texture", "100"], "Invalid value for '--texture'"),
        (["-o", "out.ply", "--texture", "512"], "a .ply has no texture"),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_runs(ball: Path, options: list[str], said: str) -> None:
    ran = invoke("mesh", str(ball), *options)
    assert ran.exit_code != 0
    assert said in " ".join(ran.output.replace("│", " ").split())


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    assert "There is no file" in invoke("mesh", str(tmp_path / "none.ply")).output


@pytest.mark.slow
def test_the_program_gets_the_options_and_its_refusal_is_shown(ball: Path) -> None:
    out = ball.with_name("mesh.ply")
    cameras = ball.with_name("cameras.json")
    cameras.write_text("{}")
    process = spawn("mesh", ball, "-o", out, "--cameras", cameras, "--box", "0", "0", "0", "1", "1", "1")
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 5
    assert "is not the cameras.json of a model" in stderr
    assert not out.exists()
