"""The benchmark over the generated ground: what it says of a command is what the command did, and so of cameras.

Does not prove that a whole training is measured: that takes minutes. Its rows are in the repository.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from ground import commands
from ground.ground import camera_errors, exponent

from splatmill_worker.scene import viewmat_of
from splatmill_worker.synthetic.ground import Flight
from splatmill_worker.synthetic.ground.capture import write_truth

PROGRAM = """
import subprocess, sys, time
print("begins", flush=True)
child = subprocess.Popen([sys.executable, "-c",
    "import time; x = bytearray(200_000_000); end = time.process_time() + 1.0\\n"
    "while time.process_time() < end: pass\\n"
    "time.sleep(1.5)"])
print("waits", flush=True)
child.wait()
print("ends", flush=True)
sys.exit(3)
"""


def test_a_command_is_measured_with_the_processes_that_it_starts(tmp_path: Path) -> None:
    usage = commands.run([sys.executable, "-c", PROGRAM], tmp_path / "log")
    assert usage.status == 3
    assert usage.cpu >= 1.0
    assert usage.seconds >= 2.5
    assert 200_000_000 < usage.memory < 400_000_000
    assert usage.silence[0] >= 2.4
    assert usage.silence[1] == "waits"
    assert [line.split()[-1] for line in (tmp_path / "log").read_text().splitlines()] == [
        "begins",
        "waits",
        "ends",
    ]


def test_camera_errors_are_those_after_the_best_similarity(tmp_path: Path) -> None:
    cameras = {f"{k}.jpg": camera for k, camera in enumerate(Flight().cameras(20, 640, 480, 0))}
    (tmp_path / "truth").mkdir()
    write_truth(cameras, tmp_path / "truth")
    turn = viewmat_of(np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.zeros(3))
    records = []
    for name, camera in cameras.items():
        pose = turn @ np.linalg.inv(camera.viewmat)
        pose[:3, 3] = 0.2 * pose[:3, 3] + [3.0, -7.0, 11.0]
        if name == "7.jpg":  # turned by two degrees about its axis
            c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
            pose[:3, :3] = pose[:3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        records.append({"name": name, "camera": {"camera_to_world": pose.tolist()}})
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": records}))
    errors = camera_errors(tmp_path / "cameras.json", tmp_path / "truth")
    assert errors["cameras"] == 20
    assert errors["rotation_deg"] == pytest.approx(0.0, abs=1e-3)
    assert errors["rotation_deg_max"] == pytest.approx(2.0, abs=1e-3)
    assert errors["metres_max"] == pytest.approx(0.0, abs=1e-3)


def test_the_exponent_is_that_of_a_power_and_none_of_one_row() -> None:
    rows = [{"photos": n, "cpu": 3.0 * n**1.5} for n in (10, 20, 80)]
    assert exponent(rows, "cpu") == pytest.approx(1.5)
    assert exponent(rows[:1], "cpu") is None
    assert exponent([*rows, {"photos": 500, "cpu": 1.0, "failed": "no memory"}], "cpu") == pytest.approx(1.5)
