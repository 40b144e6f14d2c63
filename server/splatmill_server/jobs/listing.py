"""Pages of the list of jobs: the list that is asked for, and which of its jobs belong to the page."""

from collections.abc import Mapping, Sequence

import redis

from splatmill.backplane import keys, lists
from splatmill.schema import JobPage
from splatmill_server.filters import JobFilter
from splatmill_server.jobs.links import with_links
from splatmill_server.jobs.queue_places import with_places
from splatmill_server.jobs.reading import Held, read_jobs
from splatmill_server.lists import Lists


def page(
    connection: redis.Redis, listed: Lists, cursor: str | None, limit: int, wanted: JobFilter
) -> JobPage:
    """Return a page of the jobs that `wanted` admits, newest first. Raises the problems of `Lists.page`."""

    def read(job_ids: Sequence[str]) -> Mapping[str, Held]:
        if wanted.name is not None:
            job_ids = _admitted(connection, job_ids, wanted)
        held = read_jobs(connection, job_ids)
        return {
            job_id: found
            for job_id, found in held.items()
            if wanted.admits(found.row.owner, found.row.name)
            and (wanted.states is None or found.state in wanted.states)
        }

    unfinished = wanted.states is not None and not all(state.final for state in wanted.states)
    narrowed = wanted.name is not None or unfinished
    found, following = listed.page(_lists(wanted), cursor, limit, read, narrowed=narrowed)
    jobs = [(with_links(held.job()), held.row.generation) for held in found]
    return JobPage(jobs=with_places(connection, jobs), cursor=following)


def _lists(wanted: JobFilter) -> list[str]:
    """Return the shortest lists whose union holds all jobs that a filter admits.

    A job that has ended is among the unfinished ones until the server has noticed, so these are always looked at too.
    """
    if wanted.capture is not None:
        return [lists.on_capture(wanted.capture)]
    if wanted.states is None:
        return [lists.name("jobs", owner=wanted.owner)]
    groups = [lists.UNFINISHED, *sorted(state.value for state in wanted.states if state.final)]
    return [lists.name("jobs", owner=wanted.owner, group=group) for group in groups]


def _admitted(connection: redis.Redis, job_ids: Sequence[str], wanted: JobFilter) -> list[str]:
    """Return those of the jobs whose rows the filter admits, read without their options."""
    with connection.pipeline(transaction=False) as pipe:
        for job_id in job_ids:
            pipe.hmget(keys.job(job_id), *JobFilter.FIELDS)
        rows = [dict(zip(JobFilter.FIELDS, reply, strict=True)) for reply in pipe.execute()]
    return [job_id for job_id, fields in zip(job_ids, rows, strict=True) if wanted.admits_row(fields)]
