"""Pages of lists of jobs and models that are ordered by name, size or PSNR: all records of the list are read."""

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any, TypeVar

from splatmill.schema import ListOrder, Model
from splatmill_server.base.lists import Lists
from splatmill_server.base.paging import read_cursor, write_cursor
from splatmill_server.base.problems import ProblemError

SORTED = 5000
"""Largest number of records of a list that is sorted by something else than their time: all of them are read."""

T = TypeVar("T")


def rank(order: ListOrder, name: str | None, model: Model | None) -> Any:
    """Return the place of a record among others, less for one that comes before: those without a value come last.

    name: its name, if it has one.
    model: the model, or that of the job, if it has one.
    """
    if order is ListOrder.name:
        return name is None, (name or "").casefold()
    if order is ListOrder.size:
        return inf if model is None else -model.bytes
    return inf if model is None or model.psnr is None else -model.psnr


def ranked_page(
    listed: Lists,
    names: Sequence[str],
    cursor: str | None,
    limit: int,
    order: ListOrder,
    read: Callable[[Sequence[str]], Mapping[str, T]],
    ranks: Callable[[Mapping[str, T]], Mapping[str, Any]],
) -> tuple[list[T], str | None]:
    """Return the records of a page, and the cursor of the next one; those of one rank are the newest first.

    names: the lists whose union is paged through.
    read: returns those of the records with these ids that belong to the list, by id.
    ranks: returns the `rank` of each of these records, by id.

    Raises a 422 problem for a list of more than SORTED records, and those of `Lists.page`.
    """
    position, last = read_cursor(cursor) if cursor is not None else (0, "")
    newest = [record_id for _, record_id in listed.newest(names, None, SORTED + 1)]
    if len(newest) > SORTED:
        raise ProblemError(
            "list_too_long",
            f"The list has more than {SORTED:,} records, which are not sorted by {order}.",
            advice="List the newest first, or find records by their names and tags.",
        )
    records = read(newest)
    places = ranks(records)
    ranked = sorted((record_id for record_id in newest if record_id in records), key=lambda one: places[one])
    # The page after a record that is no longer listed begins where that was.
    gone = max(0, position - 1)
    start = next((place + 1 for place, record_id in enumerate(ranked) if record_id == last), gone)
    page, following = ranked[start : start + limit], None
    if start + limit < len(ranked):
        following = write_cursor(start + limit, page[-1])
    return [records[record_id] for record_id in page], following
