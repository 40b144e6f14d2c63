"""Photos in files are read ahead in the order in which steps take them. Does not prove that the disk keeps up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from splatmill_worker.images.pixel_files import PixelFiles
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.protocol import StepResult
from splatmill_worker.splat.train.run import AHEAD, TrainingRun
from splatmill_worker.splat.views import TrainingView
from tests.support.training import first_engine, plan, split


class Noted(PixelFiles):
    """Files that note which photos are read ahead."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.asked: list[int] = []

    def read_ahead(self, values: Tensor) -> None:
        super().read_ahead(values)
        self.asked.append(values.data_ptr())


def in_files(view: TrainingView, files: PixelFiles) -> TrainingView:
    full = view.full._replace(rgb=torch.from_numpy(files.placed(view.full.rgb.numpy())))
    return replace(view, levels={1: full}, files=files)


def test_every_photo_but_the_first_of_a_round_is_asked_for_before_its_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = Noted(tmp_path)
    views = [in_files(view, files) for view in split()[0]]
    run = TrainingRun(first_engine(most=200), plan(100), views, 1.0)
    address = {view.full.rgb.data_ptr(): index for index, view in enumerate(views)}
    step, when, taken = run._step, [], []

    def watched(index: int, rates: Rates) -> StepResult:
        asked = [address[each] for each in files.asked]
        when.append(asked[::-1].index(index) if index in asked else None)
        taken.append(index)
        return step(index, rates)

    monkeypatch.setattr(run, "_step", watched)
    for _ in range(2 * len(views)):
        if len(taken) == len(views):
            files.asked.clear()
        run.advance()
    assert len(set(taken)) == len(views)
    # The order of a round is drawn when it begins, so that its first photo is not known before.
    assert [number for number, each in enumerate(when) if each is None] == [0, len(views)]
    assert len(views) > AHEAD
    assert when[1] is not None
    assert max(each for each in when if each is not None) <= 2 * AHEAD
