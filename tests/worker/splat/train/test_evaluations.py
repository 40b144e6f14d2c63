"""Proves how many photos a run is evaluated on, at which shares of its budget, and that the end shows all of them.

Does not prove that an evaluation takes the time that is assumed of it; the benchmarks record the seconds of both.
"""

from dataclasses import replace

import pytest

from splatmill.schema import TrainOptions
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.plan.decide import decide
from splatmill_worker.splat.plan.evaluated import (
    EVALUATED_AT,
    SHARE,
    SHORT_EVALUATED_AT,
    VIEW_STEPS,
    curve_views,
    evenly,
    finally_evaluated,
)
from splatmill_worker.splat.start.points import from_points
from splatmill_worker.splat.train.loop import train
from tests.support import still_life
from tests.support.plans.facts import FACTS


def test_the_choice_is_even_and_never_more_than_there_are() -> None:
    assert evenly(range(10), 4) == [0, 2, 5, 7]
    assert evenly(range(3), 4) == [0, 1, 2]
    assert evenly([], 4) == []
    assert len(finally_evaluated(range(100))) == 17


@pytest.mark.parametrize("steps", [2000, 3000, 10_000, 30_000])
@pytest.mark.parametrize(
    ("held_out", "training", "validation"), [(0, 20, 0), (1, 7, 0), (7, 43, 0), (7, 40, 3), (13, 84, 0)]
)
def test_all_evaluations_of_a_long_run_stay_within_their_share(
    held_out: int, training: int, validation: int, steps: int
) -> None:
    chosen = curve_views(held_out, training, steps, validation)
    views = (len(chosen.shares) - 1) * (chosen.held_out + chosen.training + validation)
    views += held_out + len(finally_evaluated(range(training)))
    assert VIEW_STEPS * views <= SHARE * steps
    assert min(held_out, 4) <= chosen.held_out <= held_out


def test_the_official_lego_shows_a_part_of_its_test_views_on_the_way() -> None:
    chosen = curve_views(200, 100, 8000)
    assert 10 < chosen.held_out < 40
    assert chosen.shares == EVALUATED_AT
    assert VIEW_STEPS * (13 * (chosen.held_out + chosen.training) + 200 + 17) <= SHARE * 8000


def test_short_runs_have_fewer_points() -> None:
    chosen = curve_views(7, 43, 400)
    assert chosen.shares == SHORT_EVALUATED_AT
    assert (chosen.held_out, chosen.training) == (4, 1)
    assert chosen == curve_views(7, 43, 300)


def test_the_last_point_shows_all_held_out_views_and_is_the_result() -> None:
    views = still_life.training_views()
    gaussians = from_points(*still_life.points())
    plan = decide(replace(FACTS, views=8, held_out=6), TrainOptions(steps=12), "cpu")
    counts: list[int | None] = []
    trained = train(open_engine(gaussians, "cpu"), views[6:], views[:6], plan, extent=1.1)
    counts = [point.views for point in trained.curve]
    assert counts == [4] * (len(SHORT_EVALUATED_AT) - 1) + [6]
    assert trained.held_out is not None
    assert [view.name for view in trained.held_out.views] == [view.name for view in views[:6]]
    assert trained.curve[-1].psnr == trained.held_out.psnr
    assert trained.curve[-1].train_psnr == trained.on_training.psnr
