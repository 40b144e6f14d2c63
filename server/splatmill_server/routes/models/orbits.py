"""The endpoints of orbit videos: rendered in the background, and kept with their model."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.backplane.storage import layout
from splatmill.schema import Orbit, OrbitList, OrbitRequest
from splatmill_server.access.caller import Who
from splatmill_server.requests.ownership import ModelId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.responses.files import file_response
from splatmill_server.routes.openapi import JSON_BODY, OF_MODEL, answer, binary, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/models", tags=["models"])

OrbitId = Annotated[str, Path(description="Id of the orbit video.")]


@router.post(
    "/{model_id}/orbits",
    status_code=202,
    responses=answer(200, "The video of this request, which is there already", model=Orbit)
    | problems(
        *OF_MODEL,
        "file_not_found",
        "too_many_orbits",
        *JSON_BODY,
        "size_out_of_range",
        "quota_exceeded",
        "storage_full",
        "renderer_unavailable",
    ),
    dependencies=[JSON_ONLY],
)
async def create_orbit(
    service: Shared,
    who: Who,
    response: Response,
    model_id: ModelId,
    body: Annotated[OrbitRequest | None, Body(examples=[{"seconds": 4, "width": 480, "height": 360}])] = None,
) -> Orbit:
    """Render a video (MP4) that circles the scene once, in the background, and keep it with the model.

    `Location` answers how many frames are rendered. The same request returns the same video, and begins one that has
    failed again.
    """
    made = await service.orbits.create(model_id, body or OrbitRequest(), who)
    response.headers["Location"] = made.links["self"]
    if made.state.final:
        response.status_code = 200
    return made


@router.get("/{model_id}/orbits", responses=problems(*OF_MODEL))
def list_orbits(service: Shared, model_id: ModelId) -> OrbitList:
    """List the orbit videos of a model, newest first."""
    return OrbitList(orbits=service.orbits.list(model_id))


@router.get("/{model_id}/orbits/{orbit_id}", responses=problems(*OF_MODEL, "orbit_not_found"))
def get_orbit(service: Shared, model_id: ModelId, orbit_id: OrbitId) -> Orbit:
    """Get an orbit video: its state, the frames rendered so far, and the size or the problem at its end."""
    return service.orbits.get(model_id, orbit_id)


@router.delete(
    "/{model_id}/orbits/{orbit_id}", status_code=204, responses=problems(*OF_MODEL, "orbit_not_found")
)
async def delete_orbit(service: Shared, model_id: ModelId, orbit_id: OrbitId) -> None:
    """Delete an orbit video; one that is not whole is cancelled."""
    await service.orbits.delete(model_id, orbit_id)


@router.head("/{model_id}/orbits/{orbit_id}/video", include_in_schema=False)
@router.get(
    "/{model_id}/orbits/{orbit_id}/video",
    response_class=Response,
    responses=binary("The video", "video/mp4")
    | answer(206, "The requested range of the video")
    | answer(304, "The video is unchanged")
    | problems(*OF_MODEL, "orbit_not_found", "orbit_not_ready", "file_not_found", "range_not_satisfiable"),
)
async def get_orbit_video(
    service: Shared, model_id: ModelId, orbit_id: OrbitId, request: Request
) -> Response:
    """Download an orbit video (MP4)."""
    await run_in_threadpool(service.orbits.get_whole, model_id, orbit_id)
    path = layout.orbit_video(model_id, orbit_id)
    return await file_response(request, service.storage, path, "video/mp4")
