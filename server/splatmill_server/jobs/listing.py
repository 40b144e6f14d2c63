"""Pages of the list of jobs: the list that is asked for, and which of its jobs belong to the page."""

from collections.abc import Callable, Mapping, Sequence
from string import Template
from typing import Any, NamedTuple, cast

import redis

from splatmill.backplane import keys, lists
from splatmill.schema import JobPage, ListOrder, Model
from splatmill_server.base.filters import JobFilter
from splatmill_server.base.lists import Lists
from splatmill_server.jobs.links import with_links
from splatmill_server.jobs.queue_places import QueuePlaces
from splatmill_server.jobs.ranking import rank, ranked_page
from splatmill_server.jobs.reading import Held, read_jobs


class By(NamedTuple):
    """What a list of jobs is ordered by.

    models: returns the finished models of jobs with these ids, by id, which have the size and the PSNR.
    """

    order: ListOrder
    models: Callable[[Sequence[str]], Mapping[str, Model]]


NEWEST = By(ListOrder.newest, lambda _: {})
"""The newest jobs first."""

# ARGV: number of states, states, jobs. For each job: whether it may be in one of the states (in any, if none is given),
# and the fields of its row. A verdict and a restart say more than the states do, so that such jobs are always likely.
_GLANCE = Template(
    """
local count, found = tonumber(ARGV[1]), {}

local function likely(job, verdict, generation)
  if count == 0 or verdict or generation ~= '1' then return 1 end
  local told = redis.call('XRANGE', '${job}' .. job .. ':states', '-', '+')
  for index = 2, count + 1 do
    if ARGV[index] == 'queued' and #told == 0 then return 1 end
    local wanted = '"state":"' .. ARGV[index] .. '"'
    for _, entry in ipairs(told) do
      for _, part in ipairs(entry[2]) do
        if string.find(part, wanted, 1, true) then return 1 end
      end
    end
  end
  return false
end

for index = count + 2, #ARGV do
  local row = redis.call('HMGET', '${job}' .. ARGV[index], 'verdict', 'generation', ${fields})
  found[#found + 1] = {likely(ARGV[index], row[1], row[2] or '1'), unpack(row, 3)}
end
return found
"""
).substitute(job=keys.job(""), fields=", ".join(f"'{name}'" for name in JobFilter.FIELDS))


def page(
    connection: redis.Redis,
    listed: Lists,
    places: QueuePlaces,
    cursor: str | None,
    limit: int,
    only: JobFilter,
    by: By,
) -> JobPage:
    """Return a page of the jobs that `only` admits. Raises the problems of `Lists.page` and `ranked_page`."""

    def likely(job_ids: Sequence[str]) -> list[str]:
        return _likely(connection, job_ids, only)

    def read(job_ids: Sequence[str]) -> Mapping[str, Held]:
        held = read_jobs(connection, job_ids, without_bin=True)
        return {
            job_id: held_job
            for job_id, held_job in held.items()
            if only.admits(held_job.row.owner, held_job.row.name, held_job.row.tags, held_job.row.favourite)
            and (only.states is None or held_job.state in only.states)
        }

    def admitted(job_ids: Sequence[str]) -> Mapping[str, Held]:
        return read(likely(job_ids) if narrowed else job_ids)

    def ranks(held: Mapping[str, Held]) -> dict[str, Any]:
        made = {} if by.order is ListOrder.name else by.models(list(held))
        return {job_id: rank(by.order, job.row.name, made.get(job_id)) for job_id, job in held.items()}

    narrowed = only.by_labels or only.states is not None
    if by.order is not ListOrder.newest:
        held_jobs, following = ranked_page(listed, _lists(only), cursor, limit, by.order, admitted, ranks)
    else:
        held_jobs, following = listed.page(
            _lists(only), cursor, limit, read, narrowed=narrowed, likely=likely if narrowed else None
        )
    jobs = [(with_links(held.job()), held.row.generation) for held in held_jobs]
    return JobPage(jobs=places.fill(jobs), cursor=following)


def _lists(only: JobFilter) -> list[str]:
    """Return the shortest lists whose union holds all jobs that a filter admits.

    A job that has ended is among the unfinished ones until the server has noticed, so these are always looked at too.
    """
    if only.capture is not None:
        return [lists.on_capture(only.capture)]
    if only.states is None:
        return [lists.name("jobs", owner=only.owner)]
    groups = [lists.UNFINISHED, *sorted(state.value for state in only.states if state.final)]
    return [lists.name("jobs", owner=only.owner, group=group) for group in groups]


def _likely(connection: redis.Redis, job_ids: Sequence[str], only: JobFilter) -> list[str]:
    """Return those of the jobs whose rows the filter admits, and which may be in one of its states.

    One script reads a few fields of each row, and of the states no more than whether they name a wanted one: many jobs
    that wait, or run, are looked at for a page of those that do not.
    """
    if not job_ids:
        return []
    states = sorted(state.value for state in only.states or ())
    script = connection.register_script(_GLANCE)
    replies = cast(list[list[bytes | None]], script(args=[len(states), *states, *job_ids]))
    rows = [dict(zip(("likely", *JobFilter.FIELDS), reply, strict=True)) for reply in replies]
    return [
        job_id for job_id, row in zip(job_ids, rows, strict=True) if row["likely"] and only.admits_row(row)
    ]
