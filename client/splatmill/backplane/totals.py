"""Counters and histograms of the whole service, in one hash of Redis: what no single process counts alone.

Each fact is counted by whoever writes it, in the same step: a wait by the script that takes the entry, the end of a
job by the transaction that retires it. All API processes show the same values. A Redis that comes back empty begins
at zero, which Prometheus takes for a counter that was reset.

    <name>|<label values>...            a counter
    <name>|<label values>...|<number>   the observations in one bucket of a histogram, not those below it
    <name>|<label values>...|sum        the sum of all observations
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from string import Template
from typing import Any

from splatmill.backplane import keys

_SUM = "sum"

WAITING = (0.1, 0.5, 1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21600, 86400)
"""Upper bounds of the buckets for seconds of waiting."""

WORKING = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 28800, 86400)
"""Upper bounds of the buckets for seconds of work."""


@dataclass(frozen=True)
class Total:
    """A counter, or a histogram if it has bounds.

    name: its name in Prometheus, without `_total`.
    labels: names of its labels.
    text: what it counts, a sentence.
    bounds: upper bounds of its buckets, ascending; beyond the last one there is another bucket.
    """

    name: str
    labels: tuple[str, ...]
    text: str
    bounds: tuple[float, ...] = ()


JOBS_ENDED = Total(
    "splatmill_jobs_ended",
    ("state", "code"),
    "Jobs that have ended, and the problem code of the failed ones.",
)
JOB_SECONDS = Total(
    "splatmill_job_seconds",
    ("state",),
    "Seconds from the order of a job, or its restart, to its end.",
    WORKING,
)
STAGE_SECONDS = Total(
    "splatmill_stage_seconds",
    ("stage",),
    "Seconds that the attempts at a job spent in a stage, counted at the end of the job.",
    WORKING,
)
QUEUE_WAIT = Total(
    "splatmill_queue_wait_seconds",
    ("queue",),
    "Seconds that an entry of the queue waited until a worker took it.",
    WAITING,
)
ATTEMPTS = Total(
    "splatmill_attempts",
    ("end",),
    "Attempts that have ended: reported (the attempt said how), stopped (cancelled), handed_back, limited (time or "
    "memory), crashed, superseded.",
)
ATTEMPT_CPU = Total(
    "splatmill_attempt_cpu_seconds", (), "Seconds of processor time of all attempts that have ended."
)
WORKERS_LOST = Total(
    "splatmill_workers_lost",
    ("entry",),
    "Workers that were lost with an attempt, by what became of its entry: waiting (queued again) or failed.",
)

TOTALS = (JOBS_ENDED, JOB_SECONDS, STAGE_SECONDS, QUEUE_WAIT, ATTEMPTS, ATTEMPT_CPU, WORKERS_LOST)


@dataclass
class Distribution:
    """The observations of a histogram with certain label values.

    counts: number of observations by bucket; the last one is beyond all bounds.
    sum: their sum.
    """

    counts: list[int]
    sum: float = 0.0


@dataclass
class Counted:
    """What was counted of a total, by label values: `values` of a counter, or `distributions` of a histogram."""

    values: dict[tuple[str, ...], float] = field(default_factory=dict)
    distributions: dict[tuple[str, ...], Distribution] = field(default_factory=dict)


def counted(total: Total, *labels: str, by: float = 1) -> dict[str, float]:
    """Return the increments, by field, for a counter."""
    return {_field(total, *labels): by}


def observed(total: Total, seconds: float, *labels: str) -> dict[str, float]:
    """Return the increments, by field, for an observation of a histogram."""
    bucket = next((n for n, bound in enumerate(total.bounds) if seconds <= bound), len(total.bounds))
    return {_field(total, *labels, str(bucket)): 1, _field(total, *labels, _SUM): max(0.0, seconds)}


def add(pipe: Any, increments: Mapping[str, float]) -> None:
    """Add increments, by a connection or a pipeline."""
    for name, amount in increments.items():
        pipe.hincrbyfloat(keys.TOTALS, name, amount)


def read(stored: Mapping[bytes, bytes]) -> dict[str, Counted]:
    """Return what was counted, by the name of the total, from a reply to HGETALL of `keys.TOTALS`.

    What this version does not know is left out.
    """
    known = {total.name: total for total in TOTALS}
    counted = {name: Counted() for name in known}
    for named, value in stored.items():
        name, *rest = named.decode("utf-8", "replace").split("|")
        total = known.get(name)
        if total is None or len(rest) != len(total.labels) + bool(total.bounds):
            continue
        labels = tuple(rest[: len(total.labels)])
        if not total.bounds:
            counted[name].values[labels] = float(value)
            continue
        empty = Distribution([0] * (len(total.bounds) + 1))
        distribution = counted[name].distributions.setdefault(labels, empty)
        if rest[-1] == _SUM:
            distribution.sum = float(value)
        elif rest[-1].isdigit() and int(rest[-1]) < len(distribution.counts):
            distribution.counts[int(rest[-1])] = round(float(value))
    return counted


def observing(total: Total) -> str:
    """Return a function of Lua, `observe(label, seconds)`, for a histogram with one label."""
    return Template(
        """
local function observe(label, seconds)
  local bucket, bounds = ${count}, {${bounds}}
  for number, bound in ipairs(bounds) do
    if seconds <= bound then bucket = number - 1; break end
  end
  redis.call('HINCRBY', '${key}', '${name}|' .. label .. '|' .. bucket, 1)
  redis.call('HINCRBYFLOAT', '${key}', '${name}|' .. label .. '|${sum}', math.max(0, seconds))
end
"""
    ).substitute(
        count=len(total.bounds),
        bounds=", ".join(map(str, total.bounds)),
        key=keys.TOTALS,
        name=total.name,
        sum=_SUM,
    )


def _field(total: Total, *parts: str) -> str:
    return "|".join((total.name, *parts))
