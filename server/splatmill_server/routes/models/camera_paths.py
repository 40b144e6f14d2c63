"""The endpoint of camera paths: the views along one, as videos follow it."""

from typing import Annotated

from fastapi import APIRouter, Body

from splatmill.schema import Scope, Trace, TraceRequest
from splatmill_server.access.permission import needs
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import CAMERA, JSON_BODY, problems

router = APIRouter(tags=["models"])

_VIEW = {"camera_to_world": CAMERA["camera_to_world"], "fov_y_deg": 50}


@router.post(
    "/v1/camera-paths",
    responses=problems(*JSON_BODY),
    dependencies=[JSON_ONLY],
)
@needs(Scope.read)
def trace_path(
    body: Annotated[TraceRequest, Body(examples=[{"path": {"keyframes": [_VIEW, _VIEW]}, "count": 24}])],
) -> Trace:
    """Return views along a camera path, at equal times, as a video of it shows them."""
    return Trace(views=[body.path.at(index / (body.count - 1)) for index in range(body.count)])
