"""Proves that photos which disagree with the others come first, with the reason and the pixels, and when in a run they
are compared.

Does not prove how much is found in photos of real size: `splatmill bench train --scenes passed-by` measures that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from splatmill_worker.splat.train import disagreement
from splatmill_worker.splat.train.consensus import Comparison, Glance
from splatmill_worker.splat.train.disagreement import Disagreement, Look
from splatmill_worker.splat.train.loop import train
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.views import TrainingView
from tests.support import still_life
from tests.support.training import first_engine, plan


def judged(views: list[TrainingView]) -> tuple[Disagreement, ...]:
    return train(first_engine(), views, [], plan(300), extent=1.1).disagreements


def test_what_passes_by_is_found_in_the_photos_that_show_it() -> None:
    views = still_life.training_views()
    for number in (3, 8):
        views[number].full.rgb[30:50, 36:60] = torch.tensor([250, 20, 220], dtype=torch.uint8)
    ranking = judged(views)
    assert len(ranking) == len(views)
    assert {each.name for each in ranking[:2]} == {views[number].name for number in (3, 8)}
    for each in ranking[:2]:
        assert each.reason == "moving things"
        assert float(each.outliers[32:48, 38:58].float().mean()) > 0.8
    assert [each.decibels for each in ranking] == sorted((each.decibels for each in ranking), reverse=True)


def test_other_light_is_told_from_another_camera() -> None:
    views = still_life.training_views()
    views[6].full.rgb.copy_((views[6].full.rgb.float() * 0.5).to(torch.uint8))
    views[10].full.rgb.copy_(views[0].full.rgb)  # the photo of another camera
    reasons = {each.name: each.reason for each in judged(views)}
    assert reasons[views[6].name] == "other light"
    assert reasons[views[10].name] == "wrong camera or blur"


@pytest.mark.parametrize(("cut_out", "reason"), [(12, "not cut out"), (3, "other light")])
def test_an_opaque_photo_among_cut_outs_is_not_blamed_for_its_light(
    cut_out: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = still_life.training_views()[:16]
    opaque = torch.full(views[0].full.rgb.shape[:2], 255, dtype=torch.uint8)
    views = [
        replace(view, levels={1: view.full._replace(alpha=opaque * (number >= cut_out))})
        for number, view in enumerate(views)
    ]
    flat = torch.zeros(2, 2)
    monkeypatch.setattr(
        disagreement,
        "glance",
        lambda engine, made, target, behind: Glance(target, flat, flat, flat == 0.0, 9.0),
    )
    monkeypatch.setattr(
        disagreement, "compared", lambda glances: [Comparison(flat, 0.0, flat > 0.0, -1.0) for _ in glances]
    )
    run = TrainingRun(first_engine(), plan(30), views, 1.1)
    ranking = disagreement.disagreements(run, range(len(views)))
    assert {each.reason for each in ranking if each.name == views[-1].name} == {reason}


@pytest.mark.parametrize(
    ("decibels", "reason"),
    [(0.2, None), (2.2, None), (2.3, "wrong camera or blur"), (10.0, "wrong camera or blur")],
)
def test_a_photo_that_is_hardly_worse_has_no_wrong_camera(
    decibels: float, reason: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of its pixels are 1.5 times as bad as usual, which says little where all residuals are small."""

    def compared(glances: Sequence[Glance]) -> list[Comparison]:
        return [
            Comparison(
                ratio=torch.ones(glance.residual.shape),
                median=1.5 if number == 4 else 1.0,
                outliers=torch.zeros(glance.residual.shape, dtype=torch.bool),
                decibels=decibels if number == 4 else -1.0,
            )
            for number, glance in enumerate(glances)
        ]

    monkeypatch.setattr(disagreement, "compared", compared)
    views = still_life.training_views()
    reasons = {
        each.name: each.reason
        for each in train(first_engine(), views, [], plan(300), extent=1.1).disagreements
    }
    assert reasons.pop(views[4].name) == reason
    assert set(reasons.values()) == {None}


@pytest.mark.parametrize(("photos", "steps", "at"), [(12, 60, 18), (3, 150, 30), (3, 1, 1)])
def test_photos_are_compared_once_before_they_are_learnt_by_heart(
    photos: int, steps: int, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After ten steps on each photo, after three tenths of the run, or at its end, whichever comes first."""
    compared = []

    def record(run: TrainingRun, learnt: Sequence[int]) -> tuple[Disagreement, ...]:
        assert list(learnt) == list(range(photos))
        compared.append(run.state.step)
        return ()

    monkeypatch.setattr(disagreement, "disagreements", record)
    train(first_engine(), still_life.training_views()[:photos], [], plan(steps), extent=1.1)
    assert compared == [at]


def test_photos_that_are_set_aside_are_not_compared() -> None:
    """They are not learnt when the others are compared, which is no disagreement."""
    views = still_life.training_views()
    result = train(first_engine(), views, [], replace(plan(40), validation=2), extent=1.1)
    assert len(result.validation) == 2
    assert {each.name for each in result.disagreements} == {view.name for view in views} - set(
        result.validation
    )


def test_photos_that_were_set_aside_are_not_compared_once_they_are_trained_on() -> None:
    """An attempt may go on from a checkpoint so late that it takes steps on all photos before it compares them."""
    views = still_life.training_views()
    run = TrainingRun(first_engine(), replace(plan(40), validation=2), views, 1.1)
    aside = {views[index].name for index in run.set_aside}
    assert len(aside) == 2
    look = Look(run)
    run.train_on_all()
    assert {each.name for each in look.finish()} == {view.name for view in views} - aside


def test_too_few_photos_are_not_compared() -> None:
    assert (
        train(first_engine(), still_life.training_views()[:2], [], plan(10), extent=1.1).disagreements == ()
    )
