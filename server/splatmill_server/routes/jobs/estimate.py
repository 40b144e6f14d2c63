"""The endpoint of `/v1/estimate`: how long a job would take on this server."""

from typing import Annotated

from fastapi import APIRouter, Body

from splatmill.schema import Estimate, EstimateJob, Scope
from splatmill_server.access.caller import Who
from splatmill_server.access.permission import needs
from splatmill_server.jobs.estimate import check_time, estimate
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared

router = APIRouter(tags=["jobs"])

_EXAMPLE = {"photos": 24, "options": {"preset": "draft"}}


@router.post(
    "/v1/estimate",
    responses=problems(
        *JSON_BODY,
        "unknown_option",
        "option_out_of_range",
        "capture_not_found",
        "storage_unavailable",
        "lists_not_ready",
    ),
    dependencies=[JSON_ONLY],
)
@needs(Scope.read)
def estimate_job(
    service: Shared, who: Who, request: Annotated[EstimateJob, Body(examples=[_EXAMPLE])]
) -> Estimate:
    """Check the options of a job and estimate its time from the jobs that have finished here. Nothing is created.

    Options that a job with so many photos would be refused for are refused. The jobs of all owners count, because they
    tell of the machine. No name or id of them is shown.
    """
    if request.capture is not None:
        service.captures.check_visible(who, request.capture)
        service.captures.get(request.capture)
    finished = service.finished.newest()
    if request.exact:
        recovered = request.capture is not None and service.captures.has_cameras(request.capture)
        check_time(request, finished, recovered=recovered)
    return estimate(request, finished)
