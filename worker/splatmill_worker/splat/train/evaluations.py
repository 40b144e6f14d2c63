"""Evaluates a run while it trains, and at its end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

from splatmill_worker.splat.engine.protocol import Engine
from splatmill_worker.splat.evaluate import Score, evaluate
from splatmill_worker.splat.lpips import Distances
from splatmill_worker.splat.machine import resident_memory
from splatmill_worker.splat.plan.evaluated import curve_views, evenly, finally_evaluated
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.renderer import evaluation_background, renderer
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.stopping import reason_to_stop, still_gains
from splatmill_worker.splat.views import TrainingView


@dataclass(frozen=True)
class FinalScores:
    """The scores of all held-out views, None where there are none, and of an even choice of the training views."""

    held_out: Score | None
    on_training: Score


class Evaluations:
    """Evaluates a run at shares of its budget.

    seconds: time that this has taken.
    final: the scores of the last evaluation where that was at the end of the budget; None before.
    """

    def __init__(
        self,
        run: TrainingRun,
        held_out: Sequence[TrainingView],
        evaluated: Callable[[CurvePoint, Engine], None] = lambda _point, _engine: None,
        evaluating: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> None:
        """evaluated: called with every new point of the curve.

        evaluating: called with each held-out view of the final scores, which take the time: how many, and of how many.
        """
        self._run, self._held_out = run, held_out
        self._evaluated, self._evaluating = evaluated, evaluating
        aside = len(run.set_aside)
        self._chosen = curve_views(
            len(held_out), len(run.views) - aside, run.plan.schedule.expected_steps, aside
        )
        self.seconds = 0.0
        self.final: FinalScores | None = None
        self._next = self._after_last()

    def is_due(self, run: TrainingRun) -> bool:
        """Whether the next share of the budget is reached, and opacities have recovered from a densification."""
        reached = run.progress >= self._chosen.shares[self._next]
        return reached and not (
            run.plan.densify and run.plan.schedule.unsettled(run.state.step, run.progress)
        )

    def observe(self, run: TrainingRun) -> None:
        """Evaluate, and decide whether the run ends."""
        self._evaluated(self.evaluate(), run.engine)
        run.keep_best()
        run.stopped = reason_to_stop(run)
        if not run.stopped and self._rates_fall and still_gains(run) and run.double():
            self._next = self._after_last()

    @property
    def decided(self) -> bool:
        """Whether no evaluation to come is one that decides: that at the end does not, and a gain is none while rates
        fall."""
        last = self._next >= len(self._chosen.shares) - 1
        return last or (self._run.plan.target_psnr is None and self._rates_fall)

    @property
    def _rates_fall(self) -> bool:
        """Whether rates fall before the next evaluation."""
        shares = self._chosen.shares
        return shares[min(self._next, len(shares) - 1)] > self._run.plan.schedule.annealing.hold

    def _after_last(self) -> int:
        """The index of the share after that of the last point of the curve; a run that ends there has the last one
        again, since an attempt may die after its last step and before its export.
        """
        run, shares = self._run, self._chosen.shares
        last = run.state.curve[-1] if run.state.curve else None
        reached = 0.0 if last is None else run.state.budget.progress(last.step, last.seconds)
        return min(sum(share <= reached for share in shares), len(shares) - 1)

    def evaluate(self) -> CurvePoint:
        """Evaluate now; the point is added to the curve of the run."""
        started = time.perf_counter()
        run, shares = self._run, self._chosen.shares
        while self._next < len(shares) and run.progress >= shares[self._next]:
            self._next += 1
        scores = (
            self._all()
            if run.progress >= 1.0
            else self._of(
                evenly(self._held_out, self._chosen.held_out),
                evenly(trained_on(run), self._chosen.training),
            )
        )
        self.final = scores if run.progress >= 1.0 else None
        held_out = scores.held_out
        point = CurvePoint(
            seconds=run.clock.seconds,
            step=run.state.step,
            loss=run.loss,
            psnr=None if held_out is None else held_out.psnr,
            ssim=None if held_out is None else held_out.ssim,
            gaussians=run.engine.count,
            memory=resident_memory(),
            train_psnr=scores.on_training.psnr,
            train_ssim=scores.on_training.ssim,
            views=None if held_out is None else len(held_out.views),
            validation_psnr=self._validation(),
        )
        run.state.curve = (*run.state.curve, point)
        self.seconds += time.perf_counter() - started
        return point

    def finish(self) -> FinalScores:
        """The final scores, of the scene as it is now."""
        if self.final is None:
            started = time.perf_counter()
            self.final = self._all()
            self.seconds += time.perf_counter() - started
        return self.final

    def _all(self) -> FinalScores:
        distances = self._distances() if self._run.plan.lpips and self._held_out else None
        training = finally_evaluated(trained_on(self._run))
        done = count(1)
        return self._of(
            self._held_out, training, distances, lambda: self._evaluating(next(done), len(self._held_out))
        )

    def _distances(self) -> Distances | None:
        """LPIPS's networks; None, with a warning, where their files went since training began."""
        try:
            return Distances.read()
        except ValueError as error:
            self._run.warn(f"{error}")
            return None

    def _validation(self) -> float | None:
        """Mean PSNR of the views that are set aside, with their cameras as given; None where there are none."""
        run = self._run
        aside = [run.views[index] for index in sorted(run.set_aside)]
        background = evaluation_background(run.plan, run.views)
        return evaluate(renderer(run.engine, run.plan), aside, background).psnr if aside else None

    def _of(
        self,
        held_out: Sequence[TrainingView],
        training: Sequence[TrainingView],
        distances: Distances | None = None,
        scored: Callable[[], None] = lambda: None,
    ) -> FinalScores:
        run = self._run
        render, background = renderer(run.engine, run.plan), evaluation_background(run.plan, run.views)
        return FinalScores(
            evaluate(render, held_out, background, distances, scored) if held_out else None,
            evaluate(render, training, background),
        )


def trained_on(run: TrainingRun) -> list[TrainingView]:
    """The training views that are not set aside, with their cameras as they are now."""
    return [view for index, view in enumerate(corrected(run)) if index not in run.set_aside]


def corrected(run: TrainingRun) -> tuple[TrainingView, ...]:
    """The training views with their cameras as they are now."""
    return tuple(run.views if run.poses is None else run.poses.corrected(run.views))
