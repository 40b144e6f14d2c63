"""The endpoints of `/v1/models`: finished models, their files and cameras, and images rendered from them."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.schema import (
    DOWNLOADS,
    POSTER,
    ChangeLabels,
    ListOrder,
    Model,
    ModelCameras,
    ModelDownloads,
    ModelPage,
    OrbitRequest,
    RenderRequest,
    Scope,
)
from splatmill_server.access.caller import Who
from splatmill_server.access.permission import needs
from splatmill_server.base.filters import Filter
from splatmill_server.base.paging import DEFAULT_LIMIT
from splatmill_server.requests.ownership import ListedOwner, ModelId
from splatmill_server.requests.parameters import JSON_ONLY, Cursor, Favourite, Limit, NamePart, Sort, TagOf
from splatmill_server.responses.files import attachment
from splatmill_server.responses.forward import CLIENT_GONE, forward, while_connected
from splatmill_server.responses.model_outputs import file_name, model_file, model_in_format, rendered_by_query
from splatmill_server.responses.single_file import IN_PARTS, held_format, single_file
from splatmill_server.routes.openapi import (
    CAMERA,
    CONVERTED,
    JSON_BODY,
    RENDER_REQUESTS,
    answer,
    binary,
    problems,
)
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/models", tags=["models"])

RENDERED = binary("The image", "image/png", "image/jpeg", "image/webp", "application/x-npy") | {
    304: {"description": "The image with the ETag in `If-None-Match` is unchanged."}
}
RENDER_PROBLEMS = problems(
    "model_not_found",
    "model_not_ready",
    "camera_invalid",
    "size_out_of_range",
    "model_corrupt",
    "renderer_unavailable",
    "render_timeout",
)
CAMERA_QUERY = [
    {
        "name": "camera_to_world",
        "in": "query",
        "required": True,
        "description": "The 16 numbers of the matrix, row by row, separated by commas.",
        "schema": {"type": "string"},
        "example": ",".join(str(x) for row in CAMERA["camera_to_world"] for x in row),
    },
    *(
        {"name": name, "in": "query", "required": name in ("width", "height"), "schema": {"type": kind}}
        for name, kind in (
            ("width", "integer"),
            ("height", "integer"),
            ("fov_y_deg", "number"),
            ("fx", "number"),
            ("fy", "number"),
            ("cx", "number"),
            ("cy", "number"),
            ("convention", "string"),
            ("output", "string"),
            ("format", "string"),
            ("background", "string"),
            ("quality", "integer"),
        )
    ),
]


@router.get("", responses=problems("cursor_invalid", "lists_not_ready", "list_too_long"))
def list_models(
    service: Shared,
    owner: ListedOwner,
    cursor: Cursor = None,
    limit: Limit = DEFAULT_LIMIT,
    name: NamePart = None,
    tag: TagOf = None,
    favourite: Favourite = None,
    sort: Sort = ListOrder.newest,
) -> ModelPage:
    """List finished models."""
    return service.models.list(cursor, limit, Filter(owner, name, tag, favourite), sort)


@router.get("/{model_id}", responses=problems("model_not_found", "model_not_ready", "model_corrupt"))
def get_model(service: Shared, model_id: ModelId) -> Model:
    """Get a model with its files."""
    return service.models.get(model_id)


@router.patch(
    "/{model_id}",
    responses=problems("model_not_found", "model_not_ready", "model_corrupt", *JSON_BODY, "storage_full"),
    dependencies=[JSON_ONLY],
)
def label_model(service: Shared, model_id: ModelId, change: ChangeLabels) -> Model:
    """Change the name, the tags and the star of a model and its job. Files are downloaded under its name."""
    return service.models.label(model_id, change)


@router.head("/{model_id}/files/{name:path}", include_in_schema=False)
@router.get(
    "/{model_id}/files/{name:path}",
    response_class=Response,
    responses=binary("The file", *sorted({*layout.MODEL_FILES.values(), "image/webp"}))
    | answer(206, "The requested range of the file")
    | answer(304, "The file is unchanged")
    | problems("model_not_found", "file_not_found", "model_not_ready", "range_not_satisfiable"),
)
async def get_file(service: Shared, model_id: ModelId, name: str, request: Request) -> Response:
    """Download a file of a model: `model.ply`, `report.json`, `cameras.json`, `held_out/000.webp`, ..."""
    return await model_file(service, model_id, name, request)


@router.get("/{model_id}/formats", responses=problems("model_not_found", "model_not_ready", "model_corrupt"))
def get_formats(service: Shared, model_id: ModelId) -> ModelDownloads:
    """List the file formats in which a model can be downloaded, with bytes and quality where it has been converted."""
    return service.conversions.list(model_id)


@router.get(
    "/{model_id}/download/html",
    response_class=Response,
    responses=binary("The model with its viewer in one HTML file", "text/html; charset=utf-8")
    | problems("model_not_found", "file_not_found", "model_not_ready", *CONVERTED),
)
async def download_html(service: Shared, who: Who, model_id: ModelId, request: Request) -> Response:
    """Download a model with its viewer in one HTML file, which needs no server and sends no request."""
    model = await run_in_threadpool(service.models.get, model_id)
    key = held_format(model.gaussians)
    path = await while_connected(request, service.conversions.get_path(model_id, DOWNLOADS[key], who))
    if path is None:
        return Response(status_code=CLIENT_GONE)

    def made() -> bytes:
        cameras = service.models.get_cameras(model_id)
        antialias = service.models.antialias(model_id)
        presentation, poster = service.presentations.get(model_id), None
        if any(file.name == POSTER for file in model.files):
            poster = service.storage.get(layout.model_file(model_id, POSTER))
        packed, name = service.storage.get(path), model.name or model_id
        levels = key == IN_PARTS
        return single_file(name, packed, cameras, antialias, presentation, poster, levels=levels)

    headers = {
        "Content-Disposition": attachment(await run_in_threadpool(file_name, service, model_id, ".html")),
        "Content-Security-Policy": "sandbox allow-scripts",
        "Cache-Control": "private, no-cache",
    }
    return Response(await run_in_threadpool(made), headers=headers, media_type="text/html; charset=utf-8")


@router.head("/{model_id}/download/{format}", include_in_schema=False)
@router.get(
    "/{model_id}/download/{format}",
    response_class=Response,
    responses=binary("The model in this format", *sorted({form.media_type for form in DOWNLOADS.values()}))
    | answer(206, "The requested range of the file")
    | answer(304, "The file is unchanged")
    | problems("model_not_found", "format_unknown", "model_not_ready", "range_not_satisfiable", *CONVERTED),
)
async def download(
    service: Shared,
    who: Who,
    model_id: ModelId,
    format: Annotated[str, Path(description=f"One of {', '.join(DOWNLOADS)}.")],
    request: Request,
) -> Response:
    """Download a model in a file format, such as `sog`. The first request converts it, which takes seconds."""
    return await model_in_format(service, model_id, format, request, who)


@router.get(
    "/{model_id}/cameras",
    responses=problems("model_not_found", "model_not_ready", "file_not_found", "model_corrupt"),
)
def get_cameras(service: Shared, model_id: ModelId) -> ModelCameras:
    """Get the cameras of the photos in the coordinates of the model; `split` marks the held-out ones."""
    return service.models.get_cameras(model_id)


@router.post(
    "/{model_id}/render",
    response_class=Response,
    responses=RENDERED | RENDER_PROBLEMS | problems(*JSON_BODY),
    dependencies=[JSON_ONLY],
)
@needs(Scope.read)
async def render(
    service: Shared,
    model_id: ModelId,
    request: Request,
    body: Annotated[RenderRequest, Body(openapi_examples=RENDER_REQUESTS)],
) -> Response:
    """Render an image of a model from a camera: colour, depth or opacity."""
    await run_in_threadpool(service.models.check, model_id)
    return await forward(
        service.renderer, request, rendering.render_path(model_id), body, service.settings.render_timeout
    )


@router.get(
    "/{model_id}/render",
    response_class=Response,
    responses=RENDERED | RENDER_PROBLEMS,
    openapi_extra={"parameters": CAMERA_QUERY},
)
async def render_cacheable(service: Shared, model_id: ModelId, request: Request) -> Response:
    """Render an image of a model at an address that browsers and proxies can cache."""
    await run_in_threadpool(service.models.check, model_id)
    return await rendered_by_query(service, model_id, request)


@router.post(
    "/{model_id}/orbit",
    response_class=Response,
    responses=binary("The video", "video/mp4")
    | answer(304, "The video is unchanged")
    | RENDER_PROBLEMS
    | problems(*JSON_BODY, "size_out_of_range"),
    dependencies=[JSON_ONLY],
)
@needs(Scope.read)
async def orbit(
    service: Shared,
    model_id: ModelId,
    request: Request,
    body: Annotated[OrbitRequest | None, Body(examples=[{"seconds": 4, "width": 480, "height": 360}])] = None,
) -> Response:
    """Render a video (MP4) that circles the scene once."""
    await run_in_threadpool(service.models.check, model_id)
    path, seconds = rendering.orbit_path(model_id), service.settings.orbit_timeout
    return await forward(service.renderer, request, path, body or OrbitRequest(), seconds)
