"""Rows of `bench train`: what makes two of them the same run, and which of them are compared."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from _rows import Row

import splatmill.schema
import splatmill_worker
from _train.budgets import Budget
from _train.configurations import DEFAULT, named
from _train.scenes import Scene

QUIET = 0.1
"""Share of a run's CPU seconds that other programs may use beside it; above, its seconds are not reported."""

_WORKER = Path(splatmill_worker.__file__).parent
_COMPUTES = [
    *(_WORKER / name for name in ("images", "kernels", "pipeline", "readers", "sfm", "splat", "synthetic")),
    *(_WORKER / f"{name}.py" for name in ("colmap", "scene")),
    Path(splatmill.schema.__file__).parent / "options.py",
]


@cache
def code_version() -> str:
    """A digest of the sources that a result depends on. Rows of the same digest are rows of the same code."""
    digest = hashlib.sha256()
    for place in _COMPUTES:
        if not place.exists():
            raise FileNotFoundError(f"{place} is gone; name in _COMPUTES what a result depends on now.")
        files = [place] if place.is_file() else sorted(place.rglob("*"))
        for path in files:
            if path.suffix in {".py", ".cpp", ".hpp", ".h"}:
                name, source = str(path.relative_to(place.parent)), path.read_text()
                digest.update(f"{name}\0{computing(source) if path.suffix == '.py' else source}".encode())
    return digest.hexdigest()[:12]


def computing(source: str) -> str:
    """The syntax tree of Python `source` without comments and docstrings, so that rewording them invalidates no row."""
    return ast.dump(_Textless().visit(ast.parse(source)))


class _Textless(ast.NodeTransformer):
    """Removes statements that consist of a string."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        alone = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if alone else self.generic_visit(node)


@dataclass(frozen=True)
class BenchRun:
    """One run: a scene trained in one configuration within one budget from one seed."""

    scene: Scene
    config: str
    budget: Budget
    seed: int

    def identity(self) -> Row:
        """The fields that identify the row of this run."""
        configuration = named(self.config)
        return {
            "kind": "run",
            "scene": self.scene.name,
            "config": self.config,
            "budget": self.budget.name,
            "seed": self.seed,
            "options": self.scene.options | configuration.options,
            "revised": configuration.plan,
            **({"instead": configuration.instead} if configuration.instead else {}),
        }

    def __str__(self) -> str:
        return f"{self.scene.name}, {self.config}, {self.budget.name}, seed {self.seed}"


_IDENTITY = ("kind", "scene", "config", "budget", "seed", "options", "revised", "instead", "code")


def key(row: Row) -> str:
    """The identity of a row: equal for two rows of the same run on the same code."""
    return json.dumps([row.get(name) for name in _IDENTITY], sort_keys=True)


def runs_of(
    scenes: Iterable[Scene], configs: Iterable[str], budgets: Iterable[Budget], seeds: Iterable[int]
) -> list[BenchRun]:
    """Every meaningful combination, the default first; seeds vary slowest, so that finished seeds are complete."""
    scenes, budgets = list(scenes), list(budgets)
    configs = sorted(configs, key=lambda name: name != DEFAULT)
    return [
        BenchRun(scene, config, budget, seed)
        for seed in seeds
        for budget in budgets
        for scene in scenes
        for config in configs
        if named(config).concerns(scene)
    ]


def missing(runs: list[BenchRun], rows: list[Row]) -> list[BenchRun]:
    """Those of `runs` that have no row of the present code."""
    there = {key(row) for row in rows}
    return [run for run in runs if key(run.identity() | {"code": code_version()}) not in there]


def idle(run: BenchRun, rows: list[Row]) -> bool:
    """Whether the plan of the default run (same scene, budget, seed and code) already does what the switch would do."""
    defaults, _ = _sides(rows)
    default = defaults.get((run.scene.name, run.budget.name, run.seed, code_version()))
    return default is not None and not failed(default) and not named(run.config).changes(default["plan"])


def failed(row: Row) -> bool:
    """Whether the run failed. A failed run is counted but gets no point in a figure."""
    return bool(row["outcome"] != "trained")


def latest_default(rows: list[Row]) -> list[Row]:
    """The default's rows of the last code for each scene and budget: those with time budgets, else those with steps."""
    defaults = [row for row in rows if row["kind"] == "run" and row["config"] == DEFAULT]
    timed = {row["scene"] for row in defaults if by_time(row)}
    mine = [row for row in defaults if by_time(row) or row["scene"] not in timed]
    last = {(row["scene"], row["budget"]): row["code"] for row in mine}
    return once([row for row in mine if row["code"] == last[row["scene"], row["budget"]]])


def by_time(row: Row) -> bool:
    """Whether the row's budget was in seconds."""
    return not row["budget"].endswith("steps")


def disturbed(row: Row) -> bool:
    """Whether other programs used more than QUIET of the run's CPU seconds."""
    return bool(row["others_cpu_seconds"] > QUIET * row["cpu_seconds"])


def whole(rows: Iterable[Row]) -> list[Row]:
    """The rows of runs that did not fail and have a held-out PSNR."""
    return [row for row in rows if not failed(row) and row["psnr"] is not None]


def grouped(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """The rows grouped by the values of the fields `names`, in order of appearance."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def once(rows: list[Row]) -> list[Row]:
    """The last row of every run."""
    return list({key(row): row for row in rows}.values())


Pair = tuple[Row, Row]
"""A pair of rows: the default's and the switch's."""


def compared(rows: list[Row]) -> dict[tuple[str, str, str], list[Pair]]:
    """(scene, budget, configuration) to pairs of rows: the default's and the configuration's, of one seed and code.

    Of several codes the last one counts that has both.
    """
    defaults, others = _sides(rows)
    by_place: dict[tuple[str, str, str], list[Pair]] = {}
    for row in others:
        if _place(row) in defaults:
            group = by_place.setdefault((row["scene"], row["budget"], row["config"]), [])
            group.append((defaults[_place(row)], row))
    return {
        group: [pair for pair in pairs if pair[1]["code"] == pairs[-1][1]["code"]]
        for group, pairs in by_place.items()
    }


def lonely(rows: list[Row]) -> int:
    """The number of rows of switches for which there is no default row."""
    defaults, others = _sides(rows)
    return sum(_place(row) not in defaults for row in others)


def _sides(rows: list[Row]) -> tuple[dict[Any, Row], list[Row]]:
    runs = once([row for row in rows if row["kind"] == "run"])
    defaults = {_place(row): row for row in runs if row["config"] == DEFAULT}
    return defaults, [row for row in runs if row["config"] != DEFAULT]


def _place(row: Row) -> tuple[Any, ...]:
    return row["scene"], row["budget"], row["seed"], row["code"]
