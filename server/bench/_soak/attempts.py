"""What the pipelines' record (see `pipeline`) tells of attempts: which jobs got on, and what ran twice."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any

Line = Mapping[str, Any]
"""A line of the record, in the order in which they were written."""


def interrupted(lines: Iterable[Line], moment: float, ended: Collection[str]) -> set[str]:
    """Return the jobs that had begun at a moment of the monotonic clock and had not ended.

    ended: the jobs whose end a client had seen by then.
    """
    return {line["job"] for line in lines if line["what"] == "begin" and line["at"] <= moment} - set(ended)


def got_on(lines: Iterable[Line], moment: float) -> dict[str, float]:
    """Return, by job, when it first took a step or came to its end after a moment.

    To begin is not to get on: an attempt may begin again and again.
    """
    found: dict[str, float] = {}
    for line in lines:
        if line["what"] in ("step", "end") and line["at"] > moment:
            found.setdefault(line["job"], line["at"])
    return found


def overlapping(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each attempt that began while another at the same job ran."""
    return [
        f"two attempts at {line['job']} ran at once, one of them process {line['pid']}"
        for line in lines
        if line["what"] == "begin" and line["overlap"]
    ]


def repeated(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each attempt that took steps again whose checkpoint was on its disk.

    A step is recorded once its checkpoint is stored, so a later attempt at the job on this machine must begin behind
    it. Attempts of the engine are left out: they store a checkpoint now and then.
    """
    found: list[str] = []
    taken: dict[str, int] = {}
    for line in lines:
        job, step = line["job"], line.get("step")
        if line["what"] == "begin" and step is not None and step < taken.get(job, 0):
            found.append(f"{job} was resumed from step {step} though step {taken[job]} was stored")
            taken[job] = step
        elif line["what"] == "step" and step is not None and line.get("stored", False):
            if step <= taken.get(job, 0):
                found.append(f"{job} took step {step} twice")
            taken[job] = max(step, taken.get(job, 0))
    return found


def run_again(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each job whose pipeline ran although its model was stored.

    A pipeline that has ended runs again if its attempt was killed before it had stored the model, and only then.
    """
    return [
        f"process {line['pid']} ran {line['job']} again, whose model was stored"
        for line in lines
        if line["what"] == "begin" and line["published"]
    ]
