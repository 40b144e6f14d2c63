"""Proves that the switches which replace a function of the program do what they say, on a tiny capture.

Does not prove what they are worth: `bench train` measures that.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from typing import Any

import pytest
import torch

from splatmill_worker.pipeline import training as stage
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.plan import probe
from splatmill_worker.splat.train.disagreement import Disagreement
from splatmill_worker.splat.train.run import TrainingRun
from tests.support import training
from tests.support.paths import BENCH

Switch = Any


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark's own module, which finds the others by name."""
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("_train.instead")


@pytest.fixture
def switches(instead: Any) -> dict[str, Switch]:
    """The switches that replace functions, by name."""
    known = importlib.import_module("_train.configurations").CONFIGURATIONS
    return {name: switch for name, switch in known.items() if switch.instead}


def test_every_replaced_function_is_there_and_comes_back(instead: Any, switches: dict[str, Switch]) -> None:
    assert "cleaned" in switches
    before = probe.grown, stage.train
    for switch in switches.values():
        for name, ours in switch.instead.items():
            theirs = inspect.signature(pkgutil.resolve_name(name)).parameters.values()
            positional = [each.name for each in theirs if each.kind is not each.KEYWORD_ONLY]
            named = {each.name: None for each in theirs if each.kind is each.KEYWORD_ONLY}
            inspect.signature(getattr(instead, ours)).bind(
                *positional, **named
            )  # or TypeError: it is called alike
        with instead.applied(switch.instead):
            pass
    with instead.applied(switches["probe-of-the-start"].instead):
        assert probe.grown is instead.not_grown
    assert (probe.grown, stage.train) == before
    unknown = (
        {"splatmill_worker.pipeline.training.trained": "not_grown"},
        {"splatmill_worker.pipeline.training.train": "not_there"},
    )
    for functions in unknown:
        with pytest.raises(AttributeError), instead.applied(functions):
            pass


def test_cameras_of_a_switch_of_their_recovery_are_kept_apart(switches: dict[str, Switch]) -> None:
    scenes = importlib.import_module("_train.scenes")
    assert [name for name, switch in switches.items() if switch.recovers] == ["folds-left"]
    with_cameras = scenes.Scene("given", BENCH, posed=True)
    recovered = scenes.Scene("recovered", BENCH)
    assert not switches["folds-left"].concerns(with_cameras)
    assert switches["folds-left"].concerns(recovered)
    assert switches["cleaned"].concerns(with_cameras)


def _run() -> TrainingRun:
    views, _ = training.split()
    return TrainingRun(training.first_engine(), training.plan(), views, extent=1.1)


def test_masked_outliers_count_no_longer(instead: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run, unchanged = _run(), _run()
    for each in (run, unchanged):
        for _ in range(70):
            each.advance()  # photos at full size are kept by the engine now
    outliers = torch.zeros(6, 8, dtype=torch.bool)
    outliers[:, 4:] = True
    clean = torch.zeros_like(outliers)
    photos = tuple(
        Disagreement(view.name, 0.0, 0.0, None, outliers if at == 0 else clean)
        for at, view in enumerate(run.views)
    )
    monkeypatch.setattr(instead, "disagreements", lambda _run, _learnt: photos)
    assert instead.without_outliers(run, range(len(run.views))) == photos
    mask = run.views[0].full.mask
    assert mask is not None
    assert mask[:, :48].all()
    assert not mask[:, 48:].any()
    assert all(view.full.mask is None for view in run.views[1:])
    for each in (run, unchanged):
        each.state.upcoming = (0, 1)
        each.advance()
    assert run.loss == unchanged.loss, "nothing is masked on photo 1"
    for each in (run, unchanged):
        each.advance()
    assert run.loss != unchanged.loss


def test_no_step_is_taken_on_a_photo_that_is_named(instead: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run = _run()
    named = {run.views[2].name, run.views[5].name}
    photos = tuple(
        Disagreement(view.name, 0.0, 0.0, "moving things" if view.name in named else None, torch.zeros(1, 1))
        for view in run.views
    )
    monkeypatch.setattr(instead, "disagreements", lambda _run, _learnt: photos)
    instead.without_named_photos(run, range(len(run.views)))
    taken = [run.views[run._next_view()].name for _ in range(5 * len(run.views))]
    assert set(taken) == {view.name for view in run.views} - named


def test_a_cleaned_model_is_the_one_that_is_scored(instead: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    views, held_out = training.split()
    plan = training.plan(steps=80)
    engine = training.first_engine()
    keep: list[torch.Tensor] = []

    class Half:
        def __init__(self, gaussians: Any, *_: object, **__: object) -> None:
            self.keep = torch.arange(gaussians.count) % 2 == 0
            keep.append(self.keep)

    whole = stage.train(training.first_engine(), views, held_out, plan, extent=1.1)
    monkeypatch.setattr(instead, "clean", Half)
    cleaned = instead.trained_and_cleaned(engine, views, held_out, plan, extent=1.1)
    assert cleaned.gaussians.count == int(keep[0].sum()) < whole.gaussians.count
    assert torch.equal(cleaned.gaussians.means, whole.gaussians.select(keep[0]).means)
    assert torch.equal(gaussians_of(engine).means, cleaned.gaussians.means)
    assert cleaned.held_out.psnr < whole.held_out.psnr == cleaned.curve[-1].psnr
    assert cleaned.on_training.psnr < whole.on_training.psnr
