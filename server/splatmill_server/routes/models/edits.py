"""The endpoint of edits: a new model that leaves out a part of another."""

import secrets
from typing import Annotated

import httpx
import structlog
from fastapi import APIRouter, Body, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from splatmill.backplane import rendering
from splatmill.schema import EDIT_HEADER, Edited, EditModel
from splatmill_server.access.caller import Who
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.renderer import post
from splatmill_server.edits import store_edited
from splatmill_server.requests.ownership import ModelId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.responses.forward import CLIENT_GONE, client_of, while_connected
from splatmill_server.routes.models.models import RENDER_PROBLEMS
from splatmill_server.routes.openapi import JSON_BODY, answer, problems
from splatmill_server.service import Service, Shared
from splatmill_server.space.quota import Arrival

router = APIRouter(prefix="/v1/models", tags=["models"])

log = structlog.get_logger()

_EXAMPLE = {"box": {"min": [-1, -1, -1], "max": [1, 1, 1]}, "min_opacity": 0.05, "preview": True}


@router.post(
    "/{model_id}/edits",
    status_code=201,
    response_model=Edited,
    responses=answer(200, "What the edit would do; no model was made")
    | RENDER_PROBLEMS
    | problems(*JSON_BODY, "storage_full", "quota_exceeded"),
    dependencies=[JSON_ONLY],
)
async def edit_model(
    service: Shared,
    who: Who,
    model_id: ModelId,
    request: Request,
    body: Annotated[EditModel, Body(examples=[_EXAMPLE])],
) -> Response:
    """Make a new model of the Gaussians in a box, of some opacity, or up to some size; the model itself is kept.

    The answer has the PSNR before and after, on the held-out photos. With `preview`, no model is made.
    """
    model = await run_in_threadpool(service.models.get, model_id)
    if body.preview:
        return await _edit(service, model_id, request, body, None)
    owner = await run_in_threadpool(service.models.get_owner, model_id) or who.owner
    # An edit only leaves out Gaussians.
    async with service.quota.storing(who, owner, secrets.token_hex(8), model.bytes) as room:
        return await _edit(service, model_id, request, body, room)


async def _show_as_before(service: Service, model_id: str, new_id: str, request: Request) -> None:
    """Give a new model the annotations of the one it was made from, and a picture. It is whole without them."""
    try:
        await service.presentations.inherit(model_id, new_id, request.state.caller, client_of(request))
    except ProblemError as error:
        log.warning("an edited model has no picture", model=new_id, reason=error.problem.detail)


async def _edit(
    service: Service, model_id: str, request: Request, body: EditModel, room: Arrival | None
) -> Response:
    """Have a model edited; without `room` for a new one, only return what the edit would do."""
    asked = post(
        service.renderer,
        rendering.edits_path(model_id),
        body.model_dump_json(exclude_none=True),
        {rendering.CLIENT_HEADER: client_of(request)},
        service.settings.orbit_timeout,
    )
    answer = await while_connected(request, asked)
    if answer is None:
        return Response(status_code=CLIENT_GONE)
    try:
        if answer.status_code != 200:
            problem = await answer.aread()
            return Response(problem, answer.status_code, media_type=answer.headers.get("content-type"))
        edited = Edited.model_validate_json(answer.headers[EDIT_HEADER])
        if room is not None:
            new_id = await store_edited(service.storage, model_id, body, edited, answer.aiter_raw(), room)
            await run_in_threadpool(service.models.list_new, new_id)
            await _show_as_before(service, model_id, new_id, request)
            edited = edited.model_copy(update={"model": new_id})
    except httpx.TransportError as error:
        raise ProblemError(
            "renderer_unavailable",
            f"The renderer ended while it sent the edited model ({type(error).__name__}).",
            advice="Nothing was stored. Try again in a few seconds.",
        ) from error
    finally:
        await answer.aclose()
    headers = {} if room is None else {"Location": f"/v1/models/{edited.model}"}
    return JSONResponse(edited.model_dump(mode="json"), 200 if room is None else 201, headers)
