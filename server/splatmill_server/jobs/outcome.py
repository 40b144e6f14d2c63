"""What is counted of a job that has ended: its outcome, its seconds, and those of its stages.

It is counted once, in the transaction that takes the job out of the set of unfinished ones. All times are those of the
events, by the clock of Redis, and of the row.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from splatmill.backplane import keys, totals
from splatmill.backplane.jobs.events import StoredEvent
from splatmill.backplane.jobs.fold import Fold, fold
from splatmill.backplane.jobs.row import JobRow
from splatmill.schema import PROBLEMS, JobState, StateEvent

# KEYS: unfinished jobs, totals. ARGV: job, then fields of the totals and their increments.
_RETIRE = """
if redis.call('SREM', KEYS[1], ARGV[1]) == 0 then return 0 end
for index = 2, #ARGV, 2 do redis.call('HINCRBYFLOAT', KEYS[2], ARGV[index], ARGV[index + 1]) end
return 1
"""

_STAGES = (JobState.preparing, JobState.sfm, JobState.training, JobState.exporting)


def retire(pipe: Any, row: JobRow, states: Sequence[StoredEvent]) -> None:
    """Take a job that has ended out of the set of unfinished ones, in a transaction, and count its end.

    Of several processes that see the end, the first one counts it.
    """
    arguments = [part for field in increments(row, states).items() for part in field]
    pipe.eval(_RETIRE, 2, keys.ACTIVE, keys.TOTALS, row.id, *arguments)


def increments(row: JobRow, states: Sequence[StoredEvent]) -> dict[str, float]:
    """Return what the end of a generation adds to the totals; nothing if it has not ended."""
    job = fold(row, states)
    if not job.state.final or job.finished_at is None:
        return {}
    code = job.problem.code if job.state is JobState.failed and job.problem is not None else ""
    code = code if code in PROBLEMS or not code else "other"  # labels of metrics come from closed sets
    counts = totals.counted(totals.JOBS_ENDED, job.state.value, code)
    whole = (job.finished_at - row.queued_at).total_seconds()
    counts |= totals.observed(totals.JOB_SECONDS, whole, job.state.value)
    for stage, seconds in stage_seconds(row, states).items():
        counts |= totals.observed(totals.STAGE_SECONDS, seconds, stage)
    return counts


def stage_seconds(row: JobRow, states: Sequence[StoredEvent]) -> dict[str, float]:
    """Return the seconds that the attempts of a generation spent in each stage.

    A stage ends with the next state of the same attempt, or with the job. What an attempt did last before it was lost
    is left out: nothing records when it ended.
    """
    folded = Fold(row)
    counting = [stored for stored in states if isinstance(stored.event, StateEvent) and folded.apply(stored)]
    folded.close()
    spent: defaultdict[str, float] = defaultdict(float)
    for number, stored in enumerate(counting):
        assert isinstance(stored.event, StateEvent)
        following = counting[number + 1] if number + 1 < len(counting) else None
        if following is None:
            until = folded.finished_at
        elif following.attempt == stored.attempt:
            until = following.at
        else:
            continue
        if stored.event.state in _STAGES and until is not None:
            spent[stored.event.state.value] += max(0.0, (until - stored.at).total_seconds())
    return dict(spent)
