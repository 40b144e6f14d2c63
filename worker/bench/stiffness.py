"""`bench stiffness`: how near training is to the stability limit of Adam, at boosts of the rates from 1 to 256.

    splatmill bench stiffness                             # everything: about 40 minutes of one core
    splatmill bench stiffness --part curvature --scenes fox
    splatmill bench stiffness --part runs --longest 480 --steps 120 --boosts 4 8 16 --seeds 0 1
    splatmill bench stiffness --plot-only

Parts: `needles` (Gauss-Newton blocks), `curvature` (largest eigenvalue of Adam's preconditioned Hessian over a
training), `products` (how exact the Hessian's products are), `runs` (the same trainings at boosts of the rates) and
`groups` (boost of 8, and four times that for one group), `recovery` (a jump of all rates in the midst of a training).
Rows go to results/stiffness.jsonl, the last one of the same run counts; the report is stiffness.md, the figure
figures/stiffness.png. No figure is a time.

Expected before the first run:
1. With the exact gradient, Adam would train at the limit at every boost, since its metric adapts (Cohen et al. 2022).
   With one photo a step, the second moments hold the variance between photos, which is larger than the square of the
   mean: the eigenvalue over the limit should be below 1 at a boost of 1 and grow more slowly than the boost. At 8 it
   should be within a factor of two of 1, at 16 and 32 at or above it; opacities, whose rate is largest, should lead.
2. Held-out quality should be best near the root of the ratio of steps (`boost_of`), also beyond 8 where a run is
   short, and fall by half a decibel or more at four times that.
3. Nothing should diverge up to 32, since no value moves by much more than its rate in a step. Where a run does, the
   roll-back to half the rates should save it.
4. Needles: see `_stiffness/needles.py`.

The first trial showed ratios of 0.003 to 0.05 at a boost of 8. The limit for the mean square, which photos drawn one
at a time have to keep (`_stiffness/mean_square.py`), was added after it; expected was a ratio above 1 at boosts from
8 on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from _rows import HERE, Row, append, lines, origin
from _stiffness import needles, report
from _stiffness.scenes import absence

CACHE = HERE.parent / "build" / "bench"
SCENES = ["synthetic", "fox", "lund", "lego"]
PARTS = ["needles", "curvature", "products", "runs", "groups", "recovery"]

CURVATURE_STEPS, CURVATURE_LONGEST, MOST = 240, 96, 2000
"""Steps, longest side of photos in pixels, and most Gaussians of the trainings whose Hessian is measured."""

CURVATURE_BOOSTS = [1.0, 4.0, 8.0, 16.0, 32.0]
SHARES = [0.1, 0.5]
"""Shares of the budget at which the Hessian is measured. Rates fall after 0.6."""

LONGEST = 160
"""Longest side of the photos of the runs, pixels."""

STEPS = {120: [0, 1, 2], 480: [0, 1]}
"""Seeds by number of steps; the boost of the plan is 8 (15.8 without its limit) and 7.9."""

BOOSTS = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
EXTREME = [64.0, 128.0, 256.0]
"""Boosts at which runs are made to see how they fail, with the first seed and the steps of EXTREME_STEPS."""

EXTREME_STEPS = 480
GROUP_FACTOR = 4.0
RECOVERY_AFTER, RECOVERY_FACTORS = 300, [2.0, 4.0, 16.0, 64.0]
"""Steps after which all rates of a training of EXTREME_STEPS are multiplied, and by how much: the loss is watched
from
step 260 on."""


def main(argv: list[str]) -> int:
    """Measure, and generate the report and the figure; 1 where a scene is absent."""
    asked = _parser().parse_args(argv)
    own = asked.results is None
    path = HERE / "results" / "stiffness.jsonl" if own else asked.results
    whole = True
    if not asked.plot_only:
        for row in _measure(asked):
            if row["part"] == "absent":
                whole = False
                print(row["reason"], file=sys.stderr)
                continue
            print(json.dumps(row)[:200], flush=True)
            append(path, {**row, **origin()})
    rows = report.latest(lines(path))
    figure = HERE / "figures" / "stiffness.png" if own else path.with_suffix(".png")
    page = HERE / "stiffness.md" if own else path.with_suffix(".md")
    report.draw(rows, figure)
    page.write_text(report.document(rows))
    return 0 if whole else 1


def _measure(asked: argparse.Namespace) -> Iterator[Row]:
    parts = asked.part or PARTS
    if "needles" in parts:
        for ratio in needles.RATIOS:
            yield from needles.measure(ratio)
    for name in asked.scenes:
        reason = absence(name)
        if reason is not None:
            yield {"part": "absent", "reason": reason}
            continue
        if "curvature" in parts:
            yield from _curvature(asked, name)
        if "products" in parts:
            yield from _products(asked, name)
        if "runs" in parts:
            yield from _runs(asked, name)
        if "groups" in parts:
            yield from _groups(asked, name)
        if "recovery" in parts:
            yield from _recovery(asked, name)


def _curvature(asked: argparse.Namespace, name: str) -> Iterable[Row]:
    from _stiffness.runs import Probe, training
    from _stiffness.scenes import load

    small = load(name, asked.longest or CURVATURE_LONGEST, asked.work)
    steps = asked.steps or CURVATURE_STEPS
    for boost in asked.boosts or CURVATURE_BOOSTS:
        probe = Probe(small, asked.shares)
        run = training(small, steps, boost, asked.seeds[0], most=asked.most, probe=probe)
        for row in probe.rows:
            yield {
                "scene": name, "longest": small.longest, "steps": steps, "boost": boost, "seed": asked.seeds[0],
                "outcome": run["outcome"], "recoveries": run["recoveries"], **row,
            }  # fmt: skip


def _products(asked: argparse.Namespace, name: str) -> Iterable[Row]:
    from _stiffness.products import Sampled
    from _stiffness.runs import training
    from _stiffness.scenes import load

    small = load(name, asked.longest or CURVATURE_LONGEST, asked.work)
    probe = Sampled(small, asked.shares[-1:])
    training(small, asked.steps or CURVATURE_STEPS, 8.0, asked.seeds[0], most=asked.most, probe=probe)
    yield from ({"scene": name, "longest": small.longest, **row} for row in probe.rows)


def _runs(asked: argparse.Namespace, name: str) -> Iterable[Row]:
    from _stiffness.runs import training
    from _stiffness.scenes import load

    small = load(name, asked.longest or LONGEST, asked.work)
    seeds = {asked.steps: asked.seeds} if asked.steps else STEPS
    for steps, each in seeds.items():
        for seed in each:
            boosts = asked.boosts or BOOSTS + (EXTREME if (steps, seed) == (EXTREME_STEPS, 0) else [])
            for boost in boosts:
                yield training(small, steps, boost, seed)


def _groups(asked: argparse.Namespace, name: str) -> Iterable[Row]:
    from _stiffness.curvature import COLUMNS
    from _stiffness.runs import training
    from _stiffness.scenes import load

    small = load(name, asked.longest or LONGEST, asked.work)
    for group in COLUMNS:
        yield training(small, asked.steps or min(STEPS), 8.0, asked.seeds[0], group=group, by=GROUP_FACTOR)


def _recovery(asked: argparse.Namespace, name: str) -> Iterable[Row]:
    from _stiffness.runs import ALL, training
    from _stiffness.scenes import load

    small = load(name, asked.longest or LONGEST, asked.work)
    for by in RECOVERY_FACTORS:
        yield training(small, EXTREME_STEPS, 8.0, asked.seeds[0], group=ALL, by=by, after=RECOVERY_AFTER)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bench stiffness", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=PARTS, action="append", help="only this; may be given again")
    parser.add_argument("--scenes", nargs="*", default=SCENES)
    parser.add_argument("--longest", type=int, help="longest side of the photos, pixels")
    parser.add_argument("--steps", type=int, help="steps of the trainings")
    parser.add_argument("--boosts", type=float, nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--shares", type=float, nargs="+", default=SHARES)
    parser.add_argument("--most", type=int, default=MOST, help="Gaussians where the Hessian is measured")
    parser.add_argument("--work", type=Path, default=CACHE, help="folder that keeps recovered cameras")
    parser.add_argument("--results", type=Path, help="file of rows; the report is then written beside it")
    parser.add_argument("--plot-only", action="store_true", help="report and figure from the rows there are")
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
