"""The endpoints of `/v1/models/{model_id}/shares`: links to a model for people without a key."""

from typing import Annotated

from fastapi import APIRouter, Body, Path
from starlette.responses import Response

from splatmill.schema import CreateShare, ShareList, ShareWithToken
from splatmill_server.requests.ownership import ModelId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/models/{model_id}/shares", tags=["shares"])


@router.post(
    "",
    status_code=201,
    responses=problems("model_not_found", "model_not_ready", "too_many_requests", *JSON_BODY, "storage_full"),
    dependencies=[JSON_ONLY],
)
def create_share(
    service: Shared,
    model_id: ModelId,
    response: Response,
    request: Annotated[CreateShare | None, Body(examples=[{"expires_in": "30d"}])] = None,
) -> ShareWithToken:
    """Create a link to a model. Whoever has it may see the model until it ends; its token is in this answer only."""
    made = service.shares.create(model_id, request or CreateShare())
    response.headers.update({"Cache-Control": "no-store", "Location": made.path})
    return made


@router.get("", responses=problems("model_not_found", "model_not_ready"))
def list_shares(service: Shared, model_id: ModelId) -> ShareList:
    """List the links to a model, newest first, also those that have ended, without their tokens."""
    return ShareList(shares=service.shares.list(model_id))


@router.delete(
    "/{share_id}",
    status_code=204,
    responses=problems("model_not_found", "model_not_ready", "share_not_found"),
)
def revoke_share(
    service: Shared, model_id: ModelId, share_id: Annotated[str, Path(description="Id of the link.")]
) -> Response:
    """Revoke a link at once and for good."""
    service.shares.revoke(model_id, share_id)
    return Response(status_code=204)
