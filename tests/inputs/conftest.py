"""The inputs of ../shared/inputs, built by their own scripts, and what the command line makes of them.

`built` gives the folder that a script makes; `trained` trains it as the README of the inputs has it, and gives the
report and what was written to the screen. Where the folder is absent the tests skip.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.made_once import made_once
from tests.support.paths import DATA, ROOT

INPUTS = DATA.parent / "inputs"
PLAIN_WITHOUT_CAMERAS = 27.05
"""Held-out PSNR in dB of the plain still life that all inputs are made from, whose cameras are recovered.

The mean of five runs, which went from 26.96 to 27.13.
"""

Build = Callable[..., Path]
Train = Callable[..., "Trained"]


@dataclass(frozen=True)
class Trained:
    """A run of `splatmill train`: its report, everything that it wrote to the screen, and its folder."""

    report: dict[str, Any]
    output: str
    folder: Path

    @property
    def psnr(self) -> float:
        """Of the held-out photos, in dB."""
        return float(self.report["result"]["psnr"])


def run_script(base: Path, *command: str) -> None:
    """Run a script of the inputs, with the folder of the photos and cameras that all of them are made from.

    Skips the test where the shared inputs are not on this machine.
    """
    if not INPUTS.is_dir():
        pytest.skip("the shared inputs are not on this machine")
    environment = {**os.environ, "PYTHONPATH": str(INPUTS), "SPLATMILL_REPRO_BASE": str(base)}
    subprocess.run([sys.executable, *command], env=environment, cwd=ROOT, check=True, timeout=600)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """A function (name, *kind) that builds an input once in a run of the tests. Its folder must not be changed."""

    def build(name: str, *kind: str) -> Path:
        base = made_once(
            tmp_path_factory, "inputs-base", lambda folder: run_script(folder, "-c", "import common")
        )
        script = str(INPUTS / name / "build.py")
        whole = re.sub(r"[^\w-]", "_", "-".join(("inputs", name, *kind)))
        return (
            made_once(
                tmp_path_factory, whole, lambda folder: run_script(base, script, str(folder / "input"), *kind)
            )
            / "input"
        )

    return build


@pytest.fixture
def trained(tmp_path: Path) -> Train:
    """A function (photos, *options) that runs `splatmill train` for 150 steps at 320 pixels and returns a `Trained`.

    LPIPS, which no test here is about, would take as long as the steps.
    """

    def train(photos: Path, *options: str) -> Trained:
        folder = tmp_path / "trained"
        command = [sys.executable, "-m", "splatmill", "train", str(photos), "-o", str(folder)]
        command += ["--image-size", "320", "--steps", "150", "--lpips", "off", "--fresh", "-v", *options]
        ended = subprocess.run(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600
        )
        assert ended.returncode == 0, ended.stdout[-4000:]
        report = json.loads((folder / "report.json").read_text())
        return Trained(report, ended.stdout, folder)

    return train
