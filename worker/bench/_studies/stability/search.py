"""The search for the input with the largest error in units of conditioning, by chance, by hypothesis and by scipy.

The unit is that of `state` with all three roundings and that of exp's result, so that what is known and explained does
not hide the rest. It comes from random changes of the input; a search would find the inputs where few of them happen
to be small, so what is about to become the worst is measured again with more.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings, target
from hypothesis import strategies as st
from scipy.optimize import differential_evolution, minimize
from torch import Tensor

from .conditioning import Problem, Values, state
from .engines import Engine
from .extremes import FAMILIES, Family, Numbers, decided
from .scenes import GROUPS, Scene

QUANTITIES = ("image", *GROUPS, "pose")

TARGETS: dict[str, tuple[str, ...]] = {"image": ("image",), "gradients": GROUPS, "pose": ("pose",)}
"""What is maximised: the largest ratio of these quantities."""

FEW, MANY, FINAL = 4, 16, 32
"""Changes of the input behind a unit: of every input, of one that may be the worst, of the one that is."""

NOTHING = 1e-3
"""Ratio of an input that draws nothing, or that rounding decides about."""

POPULATION = 24
"""Of differential evolution."""

RANDOM, HYPOTHESIS, OPTIMISER = "random", "hypothesis", "differential evolution, then Nelder-Mead"


class Over(Exception):
    """The time or the number of evaluations has been used up."""


@dataclass(frozen=True)
class Ratio:
    """A largest error over its unit.

    inputs: the unit is the rounding of the inputs alone.
    designed: with the error of 2^x.
    explained: with the rounding of what lies behind a splat too.
    """

    inputs: float
    designed: float
    explained: float


def posed(scene: Scene, draws: int) -> Problem:
    """The problem of a scene, as the search measures it."""
    return state(scene, draws, exponents=1.0)


def ratios(problem: Problem, engine: Engine) -> dict[str, Ratio]:
    """By quantity: the worst pixel, the worst Gaussian by the norm of its gradient's error, and the pose's norm."""
    got = engine(problem)
    units = (problem.unit, problem.designed, problem.explained)
    counted = ~problem.undecided & (problem.exact.image != 0).any(2)

    def rows(values: Values, name: str) -> Tensor:
        if name == "image":
            return values.image[counted].double()
        x = values.gradients[name].double()
        return x[None] if name == "pose" else x.reshape(len(x), -1)

    by_quantity = {}
    for name in QUANTITIES:
        error = rows(got, name) - rows(problem.exact, name)
        by_quantity[name] = Ratio(*(worst(error, rows(unit, name)) for unit in units))
    return by_quantity


def worst(error: Tensor, unit: Tensor) -> float:
    """The largest norm of a row over that of its units; infinity where one is not a number."""
    if not len(error):
        return 0.0
    shares = error.norm(dim=1) / unit.norm(dim=1)
    return float(torch.nan_to_num(shares, nan=torch.inf).max())


@dataclass(frozen=True)
class Point:
    """An input and its ratio."""

    family: Family
    numbers: tuple[float, ...]
    ratio: float

    def scene(self) -> Scene:
        return self.family.make(self.numbers)


@dataclass
class Search:
    """What one engine has been tried on.

    limit: evaluations after which `Over` is raised; None for none.
    evaluations: how many there were.
    worst: by quantity, the worst input with the ratio of MANY changes.
    tried: by target, the inputs of the largest ratios, worst first.
    known: what every input has given.
    until: CPU seconds of this process after which `Over` is raised.
    """

    engine: Engine
    limit: int | None = None
    evaluations: int = 0
    worst: dict[str, Point] = field(default_factory=dict)
    tried: dict[str, list[Point]] = field(default_factory=lambda: {k: [] for k in TARGETS})
    known: dict[tuple[str, tuple[float, ...]], dict[str, float]] = field(default_factory=dict)
    until: float = float("inf")

    def at(self, family: Family, numbers: Numbers) -> dict[str, float]:
        """The ratio of every target at an input. Raises Over."""
        if time.process_time() > self.until or (self.limit is not None and self.evaluations >= self.limit):
            raise Over
        numbers = tuple(float(x) for x in numbers)
        if (family.name, numbers) in self.known:
            return self.known[family.name, numbers]
        self.evaluations += 1
        values = self.known[family.name, numbers] = self._measured(family, numbers)
        return values

    def _measured(self, family: Family, numbers: tuple[float, ...]) -> dict[str, float]:
        scene = family.make(numbers)
        if not decided(scene):
            return dict.fromkeys(TARGETS, NOTHING)
        values = {k: x.explained for k, x in ratios(posed(scene, FEW), self.engine).items()}
        if any(x > self.best(k) for k, x in values.items()):
            again = ratios(posed(scene, MANY), self.engine)
            # A larger value with few changes was luck.
            values = {k: min(x, again[k].explained) for k, x in values.items()}
        for k, x in values.items():
            if x > self.best(k):
                self.worst[k] = Point(family, numbers, x)
        largest = {k: max(values[name] for name in names) for k, names in TARGETS.items()}
        for k, x in largest.items():
            kept = self.tried[k]
            kept.append(Point(family, numbers, x))
            kept.sort(key=lambda p: -p.ratio)
            del kept[POPULATION:]
        return {k: max(x, NOTHING) for k, x in largest.items()}

    def best(self, quantity: str) -> float:
        """The worst ratio of a quantity so far."""
        return self.worst[quantity].ratio if quantity in self.worst else NOTHING


@dataclass
class Progress:
    """The worst ratio so far of one searcher after its n-th evaluation, where it rose."""

    points: list[tuple[int, float]] = field(default_factory=list)
    evaluations: int = 0

    def add(self, ratio: float) -> None:
        self.evaluations += 1
        if not self.points or ratio > self.points[-1][1]:
            self.points.append((self.evaluations, ratio))


def at_random(search: Search, seconds: float, number: int) -> dict[str, Progress]:
    """Uniform random numbers, the families in turn; every input counts for every target."""
    draw = np.random.default_rng(number)
    progress = {k: Progress() for k in TARGETS}
    search.until = time.process_time() + seconds
    families = list(FAMILIES.values())
    try:
        while True:
            family = families[search.evaluations % len(families)]
            for k, x in search.at(family, draw.random(family.numbers).tolist()).items():
                progress[k].add(x)
    except Over:
        return progress


def by_hypothesis(search: Search, aim: str, seconds: float, number: int) -> Progress:
    """Inputs of hypothesis, which likes special and repeated values, and climbs towards its target."""
    progress = Progress()
    search.until = time.process_time() + seconds
    inputs = st.sampled_from(list(FAMILIES.values())).flatmap(
        lambda family: st.tuples(
            st.just(family), st.lists(st.floats(0, 1), min_size=family.numbers, max_size=family.numbers)
        )
    )

    def run(number: int) -> None:
        over = False

        @seed(number)
        @settings(
            max_examples=400,
            database=None,
            deadline=None,
            phases=[Phase.generate, Phase.target],
            suppress_health_check=list(HealthCheck),
        )
        @given(inputs)
        def climb(given_input: tuple[Family, list[float]]) -> None:
            nonlocal over
            if over:
                return
            try:
                ratio = search.at(*given_input)[aim]
            except Over:
                over = True
                return
            progress.add(ratio)
            target(float(np.log10(ratio)) if np.isfinite(ratio) else 300.0)

        climb()
        if over:
            raise Over

    try:
        while True:
            run(number)
            number += 1
    except Over:
        return progress


def by_optimiser(search: Search, aim: str, seconds: float, number: int) -> Progress:
    """Differential evolution over the family of the worst input so far, then simplexes around the worst."""
    progress = Progress()
    began = time.process_time()
    draw = np.random.default_rng(number)
    family = search.tried[aim][0].family if search.tried[aim] else FAMILIES["one"]

    def cost(numbers: Sequence[float]) -> float:
        ratio = search.at(family, np.clip(numbers, 0, 1).tolist())[aim]
        progress.add(ratio)
        return -float(np.log10(ratio)) if np.isfinite(ratio) else -300.0

    known = [p.numbers for p in search.tried[aim] if p.family is family][: POPULATION // 2]
    chance = [tuple(row) for row in draw.random((POPULATION - len(known), family.numbers))]
    bounds = [(0.0, 1.0)] * family.numbers
    search.until = began + seconds / 2
    with suppress(Over):
        differential_evolution(
            cost, bounds, init=np.array(known + chance), maxiter=10**6, tol=0, polish=False, rng=number
        )
    search.until = began + seconds
    with suppress(Over):
        for width in widths():
            best = next((p for p in search.tried[aim] if p.family is family), None)
            if best is None:
                break
            corners = simplex(best.numbers, width, draw)
            options = {"initial_simplex": corners, "adaptive": True, "maxfev": 10 * family.numbers}
            minimize(cost, best.numbers, method="Nelder-Mead", bounds=bounds, options=options)
    return progress


def widths() -> Iterator[float]:
    """Sizes of simplexes: from a tenth of the range down to a millionth, again and again."""
    while True:
        yield from (1e-1, 1e-2, 1e-3, 1e-6)


def simplex(point: Numbers, width: float, draw: np.random.Generator) -> np.ndarray:
    """The point, and for every coordinate the point moved along it, inwards where it would leave the range."""
    corners = np.tile(np.asarray(point), (len(point) + 1, 1))
    step = width * draw.choice([-1.0, 1.0], len(point))
    for i, x in enumerate(step):
        corners[i + 1, i] += x if 0 <= corners[i + 1, i] + x <= 1 else -x
    return np.asarray(corners)
