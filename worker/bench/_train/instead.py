"""What a switch does in place of a function of the program, where no field of the plan turns it."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch

from splatmill.schema import TrainOptions
from splatmill_worker.sfm.run import EffortResult, SfmRun
from splatmill_worker.splat.cleaning import clean
from splatmill_worker.splat.engine.open import gaussians_of
from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import evaluate
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan.evaluated import finally_evaluated
from splatmill_worker.splat.plan.facts import Facts
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train.disagreement import Disagreement, disagreements
from splatmill_worker.splat.train.loop import Trained, train
from splatmill_worker.splat.train.renderer import evaluation_background, renderer
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.views import TrainingView


@contextmanager
def applied(functions: dict[str, str]) -> Iterator[None]:
    """The functions of the program with these dotted names replaced by those of this module, as long as it lasts.

    Raises AttributeError for a name that the program or this module does not have.
    """
    with ExitStack() as stack:
        for name, ours in functions.items():
            stack.enter_context(patch(name, getattr(sys.modules[__name__], ours)))
        yield


def not_grown(first: Gaussians, count: int) -> Gaussians:
    """In place of `probe.grown`: the Gaussians of the start, whatever `count` is."""
    return first.padded(3)


def no_most_steps(facts: Facts, options: TrainOptions) -> int | None:
    """In place of `capacity.most_steps`: the budget alone ends the training."""
    return None


def left_folded(run: SfmRun, result: EffortResult) -> None:
    """In place of `unfold`: the model stays as it was mapped."""


def without_outliers(run: TrainingRun, learnt: Sequence[int]) -> tuple[Disagreement, ...]:
    """In place of `disagreements`: no step from here on counts the pixels that no other photo agrees with.

    The training photos that are measured at the end are measured without these pixels too.
    """
    photos = disagreements(run, learnt)
    _mask(run, {each.name: ~each.outliers for each in photos})
    return photos


def without_named_photos(run: TrainingRun, learnt: Sequence[int]) -> tuple[Disagreement, ...]:
    """In place of `disagreements`: no step from here on is taken on photos that disagree for a reason."""
    photos = disagreements(run, learnt)
    named = {each.name for each in photos if each.reason is not None}
    left = [index for index, view in enumerate(run.views) if view.name not in named]
    if named and left:
        following = run._next_view

        def next_left() -> int:
            index = following()
            while run.views[index].name in named:
                index = following()
            return index

        vars(run)["_next_view"] = next_left
    return photos


def trained_and_cleaned(
    engine: Engine,
    views: Sequence[TrainingView],
    held_out: Sequence[TrainingView],
    plan: Plan,
    **more: Any,
) -> Trained:
    """In place of `train`: the same, and then `clean` by the training photos, whose time counts as training."""
    trained = train(engine, views, held_out, plan, **more)
    started = time.perf_counter()
    background = evaluation_background(plan, views)
    kept = clean(
        trained.gaussians,
        [view.full for view in trained.views],
        background,
        antialias=plan.antialias,
    ).keep
    seconds = time.perf_counter() - started
    engine.replace(gaussians_of(engine).select(kept).parameters(), None, None)
    render = renderer(engine, plan)
    return replace(
        trained,
        gaussians=trained.gaussians.select(kept),
        held_out=evaluate(render, held_out, background) if held_out else None,
        on_training=evaluate(render, finally_evaluated(trained.views), background),
        seconds=trained.seconds + seconds,
    )


def _mask(run: TrainingRun, counted: dict[str, torch.Tensor]) -> None:
    """Let only the pixels `counted`, bool [h, w] by the photo's name, count, where that leaves any."""
    for view in run.views:
        if view.name not in counted or bool(counted[view.name].all()):
            continue
        full = view.full
        pixels = torch.nn.functional.interpolate(
            counted[view.name][None, None].float(), size=tuple(full.rgb.shape[:2]), mode="nearest"
        )[0, 0].bool()
        mask = pixels if full.mask is None else pixels & full.mask
        if bool(mask.any()):
            view.levels.clear()
            view.levels[1] = full._replace(mask=mask)
    # What the engine keeps of a photo is that of its old mask.
    vars(run.engine).update(_kept={}, _kept_bytes=0)
