"""The endpoints of `/s/{token}/model`: what a link to a model gives to people without a key. They only read, and only
this model. Their addresses are those of `/v1/models/{model_id}`, below another one."""

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.backplane.storage import layout
from splatmill.schema import DOWNLOADS, KeyLimits, ModelCameras, ModelDownloads, Presentation, SharedModel
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import address
from splatmill_server.responses.model_outputs import model_file, model_in_format, rendered_by_query
from splatmill_server.routes.models.models import CAMERA_QUERY, RENDER_PROBLEMS, RENDERED
from splatmill_server.routes.openapi import CONVERTED, answer, binary, problems
from splatmill_server.service import Shared
from splatmill_server.shares import StoredShare

router = APIRouter(prefix="/s/{token}/model", tags=["shares"])

LIMITS = KeyLimits(requests_per_minute=600)
"""Requests a minute through one link, whoever sends them: dragging without WebGL asks for some pictures a second."""


async def _share(
    service: Shared, request: Request, token: Annotated[str, Path(description="Token of the link.")]
) -> StoredShare:
    share = await run_in_threadpool(service.shares.get, token)
    visitor = Caller("", f"share-{share.model}-{share.id}", f"link {share.id}", frozenset(), LIMITS)
    request.state.caller = visitor  # for the access log, which does not show the token
    await service.rate.admit(visitor)
    return share


OpenShare = Annotated[StoredShare, Depends(_share)]
"""The link of the token in the address; an endpoint that takes one answers 404 and 410 where it opens nothing."""


@router.get(
    "",
    responses=problems("share_not_found", "share_ended", "model_not_found", "model_corrupt"),
)
def get_shared_model(service: Shared, share: OpenShare) -> SharedModel:
    """Get the model that a link shows."""
    return service.shares.get_model(share)


@router.head("/files/{name:path}", include_in_schema=False)
@router.get(
    "/files/{name:path}",
    response_class=Response,
    responses=binary("The file", *sorted({*layout.MODEL_FILES.values(), "image/webp"}))
    | answer(206, "The requested range of the file")
    | answer(304, "The file is unchanged")
    | problems(
        "share_not_found", "share_ended", "model_not_found", "file_not_found", "range_not_satisfiable"
    ),
)
async def get_shared_file(service: Shared, share: OpenShare, name: str, request: Request) -> Response:
    """Download a file of the model that a link shows."""
    if not share.gives(name):
        raise ProblemError("file_not_found", f"The link gives out no file {name!r}.")
    return await model_file(service, share.model, name, request)


@router.get(
    "/formats",
    responses=problems("share_not_found", "share_ended", "model_not_found", "model_corrupt"),
)
def get_shared_formats(
    service: Shared, share: OpenShare, token: Annotated[str, Path(description="Token of the link.")]
) -> ModelDownloads:
    """List the file formats in which the model that a link shows can be downloaded."""
    downloads = service.conversions.list(share.model)
    base = address(f"/s/{token}/model/download")
    formats = [form.model_copy(update={"address": f"{base}/{form.format}"}) for form in downloads.formats]
    return downloads.model_copy(update={"formats": formats})


@router.head("/download/{format}", include_in_schema=False)
@router.get(
    "/download/{format}",
    response_class=Response,
    responses=binary("The model in this format", *sorted({form.media_type for form in DOWNLOADS.values()}))
    | answer(206, "The requested range of the file")
    | answer(304, "The file is unchanged")
    | problems(
        "share_not_found",
        "share_ended",
        "model_not_found",
        "format_unknown",
        "range_not_satisfiable",
        *CONVERTED,
    ),
)
async def download_shared(
    service: Shared,
    share: OpenShare,
    format: Annotated[str, Path(description=f"One of {', '.join(DOWNLOADS)}.")],
    request: Request,
) -> Response:
    """Download the model that a link shows in a file format. The first request of anybody converts it."""
    try:
        return await model_in_format(service, share.model, format, request)
    except ProblemError as error:
        if error.problem.code != "quota_exceeded":
            raise
        raise ProblemError(  # visitors learn nothing of the owner, nor of what else is stored
            "quota_exceeded",
            f"There is no room to store the model as {format!r}.",
            advice="Ask whoever sent the link to download it in this format.",
        ) from None


@router.get(
    "/cameras",
    responses=problems(
        "share_not_found", "share_ended", "model_not_found", "file_not_found", "model_corrupt"
    ),
)
def get_shared_cameras(service: Shared, share: OpenShare) -> ModelCameras:
    """Get the cameras of the photos in the coordinates of the model that a link shows."""
    return service.shares.get_cameras(share)


@router.get("/presentation", responses=problems("share_not_found", "share_ended", "model_not_found"))
def get_shared_presentation(service: Shared, share: OpenShare) -> Presentation:
    """Get how the model that a link shows is to be shown: start view, scale, measurements and annotations."""
    return service.presentations.get(share.model)


@router.get(
    "/render",
    response_class=Response,
    responses=RENDERED | RENDER_PROBLEMS | problems("share_not_found", "share_ended"),
    openapi_extra={"parameters": CAMERA_QUERY},
)
async def render_shared(service: Shared, share: OpenShare, request: Request) -> Response:
    """Render an image of the model that a link shows."""
    return await rendered_by_query(service, share.model, request)
