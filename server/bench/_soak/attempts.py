"""Attempts in the pipelines' record (see `pipeline`): which jobs made progress, and what ran twice."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from splatmill.schema import JobState

Line = Mapping[str, Any]
"""A line of the record, in the order in which they were written."""


def interrupted(lines: Iterable[Line], moment: float, ended: Collection[str]) -> set[str]:
    """Return the jobs that had begun at a moment of the monotonic clock and had not ended.

    ended: the jobs whose end a client had seen by then.
    """
    return {line["job"] for line in lines if line["what"] == "begin" and line["at"] <= moment} - set(ended)


def got_on(lines: Iterable[Line], moment: float) -> dict[str, float]:
    """Return, by job, when the engine first emitted an event or came to its end after a moment.

    To begin is not to get on: an attempt may begin again and again.
    """
    moments: dict[str, float] = {}
    for line in lines:
        if line["what"] in ("step", "stored", "end") and line["at"] > moment:
            moments.setdefault(line["job"], line["at"])
    return moments


def busy_with_others(lines: Iterable[Line], moment: float, jobs: Collection[str]) -> float:
    """Return for how many seconds after a moment attempts at other jobs than these ran.

    An attempt that was killed counts up to its last line. The soak has one worker, so no two attempts run at once.
    """
    began: dict[int, float] = {}
    last: dict[int, float] = {}
    for line in lines:
        if line["job"] not in jobs and line["at"] > moment:
            began.setdefault(line["pid"], line["at"])
            last[line["pid"]] = line["at"]
    return sum(last[pid] - began[pid] for pid in began)


def overlapping(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each attempt that began while another at the same job ran."""
    return [
        f"two attempts at {line['job']} ran at once, one of them process {line['pid']}"
        for line in lines
        if line["what"] == "begin" and line["overlap"]
    ]


def repeated(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each attempt that did work again whose result was on its disk.

    A checkpoint is recorded once it is stored, so a later attempt at the job on this machine must train on behind it.
    Cameras are stored when the training begins, so no later attempt may recover them again, and so are the units of a
    scene in tiles when they are done.
    """
    sentences: list[str] = []
    units: set[tuple[str, str]] = set()
    stored: dict[str, int] = {}
    posed: dict[str, int] = {}
    for line in lines:
        job, pid = line["job"], line["pid"]
        step: Any = line.get("step")
        if line["what"] == "resume":
            if step < stored.get(job, 0):
                sentences.append(f"{job} was resumed from step {step} though step {stored[job]} was stored")
        elif line["what"] == "stored":
            if step < stored.get(job, 0):
                sentences.append(f"{job} stored step {step} after step {stored[job]}")
            stored[job] = max(step, stored.get(job, 0))
        elif line["what"] == "unit stored":
            units.add((job, line["unit"]))
        elif line["what"] == "unit" and (job, line["unit"]) in units:
            sentences.append(f"process {pid} did {line['unit']} of {job} again, which was stored")
        elif line["what"] == "step" and line["stage"] == JobState.training and step is None:
            posed.setdefault(job, pid)
        elif line["what"] == "step" and line["stage"] == "mapping" and posed.get(job, pid) != pid:
            sentences.append(f"process {pid} recovered the cameras of {job} again, which were stored")
    return list(dict.fromkeys(sentences))


def resumptions(lines: Iterable[Line]) -> int:
    """Return how many attempts trained on from a checkpoint."""
    return sum(line["what"] == "resume" and line["step"] > 0 for line in lines)


def run_again(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each job whose pipeline ran although its model was stored.

    A pipeline that has ended runs again if its attempt was killed before it had stored the model, and only then.
    """
    return [
        f"process {line['pid']} ran {line['job']} again, whose model was stored"
        for line in lines
        if line["what"] == "begin" and line["published"]
    ]
