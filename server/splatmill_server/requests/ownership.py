"""Checks that a caller may know of a record. Records of other owners answer as if there were none.

Endpoints take ids as parameters of the types `CaptureId`, `JobId` and `ModelId`, which include the check: an endpoint
that forgets the check does not exist, because it would have no id.
"""

from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Path, Query
from starlette.concurrency import run_in_threadpool

from splatmill_server.access.caller import Caller, Who
from splatmill_server.service import Shared


async def _off_the_loop(check: Callable[[Caller, str], None], who: Caller, record_id: str) -> str:
    """Check in a thread of the pool what an admin needs no check for, and return the id."""
    if not who.admin:
        await run_in_threadpool(check, who, record_id)
    return record_id


async def _capture_id(
    service: Shared, who: Who, capture_id: Annotated[str, Path(description="Id of the capture.")]
) -> str:
    return await _off_the_loop(service.captures.check_visible, who, capture_id)


async def _job_id(
    service: Shared, who: Who, job_id: Annotated[str, Path(description="Id of the job.")]
) -> str:
    return await _off_the_loop(service.jobs.check_visible, who, job_id)


async def _model_id(
    service: Shared,
    who: Who,
    model_id: Annotated[str, Path(description="Id of the model, which is that of its job.")],
) -> str:
    return await _off_the_loop(service.models.check_visible, who, model_id)


async def _listed_owner(
    who: Who,
    owner: Annotated[
        str | None,
        Query(max_length=64, description="List only this owner's records. It has a meaning for admins only."),
    ] = None,
) -> str | None:
    return who.listed_owner(owner)


CaptureId = Annotated[str, Depends(_capture_id)]
"""The path parameter `capture_id`, the id of a capture that the caller may use."""

JobId = Annotated[str, Depends(_job_id)]
"""The path parameter `job_id`, the id of a job that the caller may know of."""

ModelId = Annotated[str, Depends(_model_id)]
"""The path parameter `model_id`, the id of a model that the caller may know of."""

ListedOwner = Annotated[str | None, Depends(_listed_owner)]
"""The owner whose records a list holds, or None for those of all owners."""
