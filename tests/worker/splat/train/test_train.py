"""Proves that training learns held-out views, ends on its budget, resumes, stops and recovers; on a tiny scene.

Does not prove quality or speed on real photos: those are measured by `bench train` and by the data tests.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from splatmill_worker.errors import Cancelled, FailureName, TrainingFailed
from splatmill_worker.splat.engine.open import gaussians_of, open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.budget import Budget, Clock
from splatmill_worker.splat.plan.rates import Annealing, boost_of
from splatmill_worker.splat.start import frusta
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.train import checkpoint, curve, observers
from splatmill_worker.splat.train.loop import Hooks, started_full, train
from splatmill_worker.splat.train.observers import TrainingProgress
from splatmill_worker.splat.train.renderer import evaluation_background
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life
from tests.support.training import first_engine, plan, split


@pytest.mark.slow
def test_held_out_views_are_learned() -> None:
    views, held_out = split()
    trained = train(first_engine(), views, held_out, plan(400), extent=1.1)
    assert trained.stopped == "the budget is spent"
    assert trained.steps == 400
    curve = [point.psnr for point in trained.curve]
    assert curve[-1] is not None
    assert curve[0] is not None
    assert curve[-1] > curve[0] + 4.0
    assert trained.held_out is not None
    assert trained.held_out.psnr > 18.0
    assert trained.held_out.psnr == pytest.approx(curve[-1], abs=1e-6)
    assert trained.curve[-1].views == len(held_out)
    assert trained.curve[-1].train_psnr == trained.on_training.psnr
    assert 1500 < trained.gaussians.count <= 4000
    assert trained.gaussians.degree == 1
    assert bool(trained.gaussians.finite().all())


def test_rates_follow_the_measured_number_of_steps() -> None:
    """The forecast of a million steps is wrong, and the run finds out."""
    views, _ = split()
    wrong = plan(None, 1000.0)
    course = replace(wrong.schedule, annealing=Annealing(boost=None), expected_steps=10**6)
    run = TrainingRun(first_engine(), replace(wrong, schedule=course), views, 1.1)
    assert run.rates(0.0).log_scales == pytest.approx(5e-3)
    # Sixty steps on small photos, which tell nothing of the others, and a hundred that do.
    for _ in range(159):
        run.advance()
        run.clock = Clock(run.clock.seconds + 0.5)
    assert run.rates(0.0).log_scales == pytest.approx(5e-3)
    run.advance()
    run.pace.seconds = 1.0
    assert run.rates(0.0).log_scales == pytest.approx(5e-3 * boost_of(160 + 920), rel=0.02)


@pytest.mark.slow
def test_there_are_never_more_gaussians_than_allowed() -> None:
    views, held_out = split()
    trained = train(first_engine(), views, held_out, plan(300, max_gaussians=2200), extent=1.1)
    assert trained.held_out is not None
    assert trained.held_out.psnr > 17.0
    assert trained.gaussians.count <= 2200
    assert trained.limited
    assert not train(first_engine(), views, [], plan(120, max_gaussians=10**6), extent=1.1).limited


def test_a_run_that_may_add_none_says_whether_a_limit_is_why() -> None:
    full = plan(10, densify=False)
    assert started_full(full)
    assert not started_full(replace(full, forced=("densify",)))
    assert not started_full(replace(full, densify=True))


@pytest.mark.slow
def test_dark_surfaces_are_no_holes_over_random_colours() -> None:
    """Over black, what is not there looks like a dark wall, and training has no reason to put one."""
    views = [
        TrainingView(view.name, {1: view.full._replace(rgb=torch.full_like(view.full.rgb, 4))})
        for view in split()[0]
    ]
    through: dict[str, float] = {}
    for background in ("black", "random"):
        engine = first_engine()
        train(engine, views, [], plan(400, background=background), extent=1.1)
        target = views[0].full
        _, alpha, _ = engine.forward(
            target.viewmat, target.K, target.camera.width, target.camera.height, degree=1
        )
        through[background] = float((alpha < 0.9).float().mean())
    assert through["black"] > 0.5
    assert through["random"] < 0.2


def test_opaque_photos_are_evaluated_over_black_and_transparent_ones_over_white() -> None:
    views, _ = split()
    opaque = views[0]
    clear = TrainingView("clear", {1: opaque.full._replace(alpha=opaque.full.rgb[..., 0])})
    for background, judged, colour in (
        ("random", [opaque], 0.0),
        ("random", [opaque, clear], 1.0),
        ("white", [opaque], 1.0),
        ("black", [clear], 0.0),
    ):
        assert evaluation_background(plan(background=background), judged).tolist() == [colour] * 3


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes() -> None:
    views, _ = split()
    first = train(first_engine(), views, [], plan(120), extent=1.1).gaussians
    second = train(first_engine(), views, [], plan(120), extent=1.1).gaussians
    other = train(first_engine(), views, [], plan(120, seed=1), extent=1.1).gaussians
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert other.count != first.count or not torch.equal(other.means, first.means)


@pytest.mark.slow
def test_the_reference_trains_through_the_same_loop_and_agrees() -> None:
    views, _ = split()
    course = replace(plan().schedule, budget=Budget(12), resolution=((0, 2),))
    losses: dict[str, list[float]] = {}
    for kernels in ("cpu", "reference"):
        short = plan(densify=False, kernels=kernels)
        short = replace(short, schedule=course)
        trained = train(first_engine(kernels, 200), views, [], short, extent=1.1)
        losses[kernels] = [point.loss for point in trained.curve] + [trained.on_training.mse]
    # Adam divides by the gradient's own size, so that parameters with almost none (the turn of a ball) may take
    # either sign of a full step; what is seen stays together.
    assert losses["cpu"] == pytest.approx(losses["reference"], rel=2e-3)


@pytest.mark.slow
def test_a_time_budget_ends_on_time_with_rates_annealed() -> None:
    views, held_out = split()
    reports: list[TrainingProgress] = []
    hooks = Hooks(progress=reports.append)
    trained = train(first_engine(), views, held_out, plan(None, 2.0), extent=1.1, hooks=hooks)
    assert trained.seconds == pytest.approx(2.0, rel=0.05)
    assert trained.curve[-1].seconds == pytest.approx(trained.seconds, abs=0.1)
    assert reports
    assert all(report.steps >= report.step for report in reports)


def test_a_run_that_too_few_photos_end_says_so() -> None:
    views, held_out = split()
    course = plan(30, 600.0)
    course = replace(course, schedule=replace(course.schedule, ends_at=30))
    trained = train(first_engine(), views, held_out, course, extent=1.1)
    assert trained.steps == 30
    assert trained.stopped == f"{len(views)} photos from one side are too few for more than 30 steps"


def test_a_resumed_run_goes_on_where_it_was(tmp_path: Path) -> None:
    views, held_out = split()
    whole = plan(240)

    class PowerCutError(Exception):
        pass

    def save_and_die(snapshot: Snapshot) -> None:
        if snapshot.state.step >= 100:
            checkpoint.save(tmp_path, snapshot)
            raise PowerCutError

    with pytest.raises(PowerCutError):
        train(
            first_engine(), views, held_out, whole, extent=1.1,
            hooks=Hooks(checkpoint=save_and_die, checkpoint_seconds=0.0),
        )  # fmt: skip
    snapshot = checkpoint.load(tmp_path)
    assert snapshot is not None
    assert snapshot.state.step == 100
    resumed = train(first_engine(), views, held_out, whole, extent=1.1, resume_from=snapshot)
    straight = train(first_engine(), views, held_out, whole, extent=1.1)
    assert resumed.steps == 240
    assert resumed.seconds > snapshot.seconds
    assert [point.step for point in resumed.curve] == [point.step for point in straight.curve]
    assert resumed.held_out is not None
    assert straight.held_out is not None
    assert resumed.held_out.psnr == pytest.approx(straight.held_out.psnr, abs=0.5)


def test_a_run_that_had_ended_is_evaluated_when_resumed() -> None:
    views, held_out = split()
    last: list[Snapshot] = []
    whole = plan(40, densify=False)
    hooks = Hooks(checkpoint=last.append, checkpoint_seconds=0.0)
    train(first_engine(), views, held_out, whole, extent=1.1, hooks=hooks)
    assert last[-1].state.step == 39
    ended = replace(last[-1], state=replace(last[-1].state, step=40))
    resumed = train(first_engine(), views, held_out, whole, extent=1.1, resume_from=ended)
    assert resumed.curve[-1].step == resumed.steps
    assert resumed.held_out is not None


def test_checkpoints_are_close_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that advances by a second before each step."""
    now = 0

    def tick() -> bool:
        nonlocal now
        now += 1
        return False

    monkeypatch.setattr(observers, "time", SimpleNamespace(monotonic=lambda: now))
    views, held_out = split()
    stored: list[int] = []
    hooks = Hooks(
        cancelled=tick,
        checkpoint=lambda snapshot: stored.append(snapshot.state.step),
        checkpoint_seconds=10.0,
    )
    train(first_engine(), views, held_out, plan(40, densify=False), extent=1.1, hooks=hooks)
    # After 3 s, the first step past 2.5; after another 3 and 6, as long as since the beginning; then after 10 each.
    assert stored == [3, 6, 12, 22, 32]


def test_a_cancel_is_seen_at_the_next_step() -> None:
    views, held_out = split()
    asked = iter(range(10_000))
    with pytest.raises(Cancelled):
        train(
            first_engine(),
            views,
            held_out,
            plan(300),
            extent=1.1,
            hooks=Hooks(cancelled=lambda: next(asked) >= 7),
        )
    assert next(asked) == 8


class PhotoLog:
    """An engine that keeps the numbers of the photos that steps were taken on."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.photos: list[int] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def train_photo(self, *args: Any, **named: Any) -> Any:
        self.photos.append(named["key"][0])
        return self._engine.train_photo(*args, **named)


def test_a_target_ends_the_run_by_photos_that_it_does_not_train_on() -> None:
    views, held_out = split()
    black = [
        TrainingView(view.name, {1: view.full._replace(rgb=torch.zeros_like(view.full.rgb))})
        for view in held_out
    ]
    engine = PhotoLog(first_engine())
    trained = train(engine, views, black, plan(2000, target_psnr=15.0, validation=2), extent=1.1)
    assert trained.steps < 2000
    reached = trained.curve[-1].validation_psnr
    assert reached is not None
    assert reached >= 15.0
    assert trained.stopped == f"the validation photos (2) reached {reached:.2f} dB"
    assert trained.held_out is not None
    assert trained.held_out.psnr < 10.0
    assert trained.validation == tuple(views[index].name for index in (3, 9))
    assert set(engine.photos) == set(range(len(views))) - {3, 9}
    assert not set(trained.validation) & {view.name for view in trained.on_training.views}


def test_held_out_photos_reach_no_target() -> None:
    views, held_out = split()
    trained = train(first_engine(), views, held_out, plan(60, target_psnr=5.0), extent=1.1)
    assert trained.curve[0].psnr is not None
    assert trained.curve[0].psnr > 5.0
    assert trained.stopped == "the budget is spent"


@pytest.mark.parametrize(
    ("decides", "last"), [({"target_psnr": 60.0}, 160), ({"stops_when_flat": True}, 120)]
)
def test_photos_set_aside_are_trained_on_after_the_last_decision(decides: dict[str, Any], last: int) -> None:
    views, held_out = split()
    engine = PhotoLog(first_engine())
    short = plan(200, **decides, validation=2, densify=False)
    trained = train(engine, views, held_out, short, extent=1.1)
    measured = [point.step for point in trained.curve if point.validation_psnr is not None]
    assert max(measured) == last
    assert not {3, 9} & set(engine.photos[:last])
    assert {3, 9} <= set(engine.photos[last:])
    assert trained.stopped.startswith("the budget is spent")


@pytest.mark.parametrize("least", [0.0, 50.0])
def test_a_run_ends_when_a_doubling_of_its_steps_gains_too_little(
    least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(curve, "GAIN_FROM", 0)
    views, held_out = split()
    course = plan(100, stops_when_flat=True, least_gain=least, validation=2, densify=False)
    course = replace(course, schedule=replace(course.schedule, resolution=((0, 1),)))
    trained = train(first_engine(), views, held_out, course, extent=1.1)
    ended, _, gained = trained.stopped.partition("; ")
    assert float(re.findall(r"the last doubling gained (-?[\d.]+) dB", gained)[0]) > 0.0
    if least:
        assert trained.steps == 60  # half of 40 more, where two points of the curve lie in the second half
        assert ended == "another doubling of the steps would gain less than 50 dB"
    else:
        assert trained.steps == 100
        assert ended == "the budget is spent"


def test_a_resumed_run_sets_the_same_photos_aside() -> None:
    views, held_out = split()
    course = plan(200, target_psnr=60.0, validation=2, densify=False)
    kept: list[Snapshot] = []
    hooks = Hooks(checkpoint=kept.append, checkpoint_seconds=0.0)
    train(first_engine(), views, held_out, course, extent=1.1, hooks=hooks)
    middle = next(snapshot for snapshot in kept if snapshot.state.step == 100)
    late = next(snapshot for snapshot in kept if snapshot.state.step == 170)
    for snapshot, aside in ((middle, True), (late, False)):
        engine = PhotoLog(first_engine())
        resumed = train(engine, views, held_out, course, extent=1.1, resume_from=snapshot)
        assert resumed.validation == tuple(views[index].name for index in (3, 9))
        assert bool({3, 9} & set(engine.photos[:30])) is not aside


class Sabotaged:
    """An engine whose parameters are thrown far away at given steps, as a diverging optimiser would."""

    def __init__(self, engine: Any, at: set[int], spoil: Any) -> None:
        self._engine, self._at, self._spoil = engine, at, spoil

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def train_photo(self, *args: Any, step: int, **named: Any) -> Any:
        result = self._engine.train_photo(*args, step=step, **named)
        if step in self._at:
            parameters = self._engine.parameters()
            self._spoil(parameters)
            self._engine.replace(parameters, *self._engine.moments())
        return result


def thrown_away(parameters: dict[str, torch.Tensor]) -> None:
    parameters["sh"] += 40.0


def spoilt(parameters: dict[str, torch.Tensor]) -> None:
    parameters["means"][:5] = math.nan


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [thrown_away, spoilt])
def test_a_planted_divergence_is_rolled_back(spoil: Any) -> None:
    views, held_out = split()
    warnings: list[str] = []
    engine = Sabotaged(first_engine(), {330}, spoil)
    course = plan(600, densify=False)
    trained = train(engine, views, held_out, course, extent=1.1, hooks=Hooks(warn=warnings.append))
    assert trained.recoveries == 1
    assert len(warnings) == 1
    assert "last good state" in warnings[0]
    assert trained.failure is None
    assert trained.held_out is not None
    assert trained.held_out.psnr > 17.5
    assert bool(trained.gaussians.finite().all())


def test_what_diverges_again_and_again_stops_with_the_last_good_state() -> None:
    views, held_out = split()
    engine = Sabotaged(first_engine(), set(range(330, 5000, 5)), thrown_away)
    trained = train(engine, views, held_out, plan(900, densify=False), extent=1.1)
    assert trained.failure is not None
    assert trained.failure.name is FailureName.divergence
    assert trained.stopped == str(trained.failure)
    assert trained.held_out is not None
    assert trained.held_out.psnr > 15.0
    assert bool(trained.gaussians.finite().all())


def test_a_scene_that_no_camera_sees_is_empty_by_name() -> None:
    views, held_out = split()
    behind = gaussians_of(first_engine())
    behind.means.add_(torch.tensor([0.0, 0.0, 500.0]))
    with pytest.raises(TrainingFailed) as failed:
        train(open_engine(behind, "cpu"), views, [], plan(300, densify=False), extent=1.1)
    assert failed.value.name is FailureName.empty_scene
    assert held_out


@pytest.mark.slow
def test_transparent_photos_train_over_random_backgrounds() -> None:
    views = still_life.training_views(alpha=True)
    targets = [view.full for view in views]
    points, colors = frusta.sample_frusta(targets, 2500, 0)
    engine = open_engine(from_points(points, colors), "cpu")
    trained = train(engine, views[1:], views[:1], plan(400, background="random", densify=False), extent=1.1)
    assert trained.held_out is not None
    assert trained.held_out.psnr > 17.0
    target = views[0].full
    _, alpha, _ = engine.forward(
        target.viewmat, target.K, target.camera.width, target.camera.height, degree=1
    )
    assert target.alpha is not None
    hidden = target.alpha == 0
    assert float(alpha[hidden].mean()) < 0.25
    assert float(alpha[~hidden].mean()) > 0.8


def test_masked_pixels_teach_nothing() -> None:
    views, _ = split()
    target = views[0].full
    mask = torch.ones(target.rgb.shape[:2], dtype=torch.bool)
    mask[:, : target.rgb.shape[1] // 2] = False
    spoilt_rgb = target.rgb.clone()
    spoilt_rgb[~mask] = 255
    results: list[Gaussians] = []
    for rgb in (target.rgb, spoilt_rgb):
        view = replace(views[0], levels={1: target._replace(rgb=rgb, mask=mask)})
        course = plan(30, densify=False)
        course = replace(course, schedule=replace(course.schedule, resolution=((0, 1),)))
        results.append(train(first_engine(), [view], [], course, extent=1.1).gaussians)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
