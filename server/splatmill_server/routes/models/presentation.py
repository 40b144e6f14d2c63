"""The endpoints of how a model is shown to people: start view, scale, measurements and annotations."""

from typing import Annotated

from fastapi import APIRouter, Body, Request

from splatmill.schema import ChangePresentation, Presentation
from splatmill_server.access.caller import Who
from splatmill_server.requests.ownership import ModelId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.responses.forward import client_of
from splatmill_server.routes.models.models import RENDER_PROBLEMS
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/models", tags=["models"])

_EXAMPLE = {"annotations": [{"point": [0, 0, 0], "text": "The lid"}], "scale": {"factor": 12.5, "unit": "cm"}}


@router.get("/{model_id}/presentation", responses=problems("model_not_found", "model_not_ready"))
def get_presentation(service: Shared, model_id: ModelId) -> Presentation:
    """Get how a model is shown to people: its start view, scale, measurements and annotations."""
    return service.presentations.get(model_id)


@router.patch(
    "/{model_id}/presentation",
    responses=RENDER_PROBLEMS | problems(*JSON_BODY, "storage_full", "quota_exceeded"),
    dependencies=[JSON_ONLY],
)
async def change_presentation(
    service: Shared,
    who: Who,
    model_id: ModelId,
    request: Request,
    body: Annotated[ChangePresentation, Body(examples=[_EXAMPLE])],
) -> Presentation:
    """Change how a model is shown to people. Fields that are left out stay as they are.

    With another start view or background, the server renders the picture `poster.jpg` of the model, which links show.
    """
    return await service.presentations.save(model_id, body, who, client_of(request))
