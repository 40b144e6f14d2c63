"""What a model gives out: files, other formats, renderings. The endpoints of models and of links answer with it."""

import re

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.schema import RenderRequest
from splatmill_server.access.caller import Caller
from splatmill_server.background.conversions import format_of_key
from splatmill_server.responses.files import file_response
from splatmill_server.responses.forward import CLIENT_GONE, forward, while_connected
from splatmill_server.service import Service

_NOT_IN_FILE_NAMES = re.compile(r'[\x00-\x1f\x7f<>:"/\\|?*]+')
"""Characters that a system that people use does not allow in the names of files."""

_NAME_LENGTH = 60
"""Characters of a model's name in that of a file: with four bytes each, a file system has room for them (255 bytes)."""


async def model_file(service: Service, model_id: str, name: str, request: Request) -> Response:
    """Return a file of a model, or the range of it that the request names."""
    entry = await run_in_threadpool(service.models.get_file, model_id, name)
    download = await _saved_as(service, model_id, ".ply", request) if name == "model.ply" else None
    media_type = layout.model_media_type(name) or "application/octet-stream"
    return await file_response(request, service.storage, entry.path, media_type, download_name=download)


async def model_in_format(
    service: Service, model_id: str, key: str, request: Request, who: Caller | None = None
) -> Response:
    """Return a model in the format of this key, such as `sog`, converted first if nobody has asked for it before.

    who: the caller; None for somebody with a link.
    """
    form = format_of_key(key)
    path = await while_connected(request, service.conversions.get_path(model_id, form, who))
    if path is None:
        return Response(status_code=CLIENT_GONE)
    name = await _saved_as(service, model_id, form.suffix, request)
    return await file_response(request, service.storage, path, form.media_type, download_name=name)


async def _saved_as(service: Service, model_id: str, suffix: str, request: Request) -> str:
    """Return the name under which a file of a model is saved. Requests for a range need none of their own."""
    if "range" in request.headers:
        return f"{model_id}{suffix}"
    return await run_in_threadpool(file_name, service, model_id, suffix)


def file_name(service: Service, model_id: str, suffix: str) -> str:
    """Return the name of a file of a model: its name, as far as file systems accept it, or its id."""
    name = _NOT_IN_FILE_NAMES.sub("-", service.models.get_name(model_id) or "").strip(" .-")
    return f"{name[:_NAME_LENGTH].rstrip(' .-') or model_id}{suffix}"


async def rendered_by_query(service: Service, model_id: str, request: Request) -> Response:
    """Return an image of a model as the query of the request describes it.

    Raises `RequestValidationError`, which names the parameter, for a query that describes none.
    """
    try:
        body = RenderRequest.from_query(request.query_params)
    except ValidationError as error:
        located = [{**fault, "loc": ("query", *fault["loc"])} for fault in error.errors()]
        raise RequestValidationError(located) from error
    path, seconds = rendering.render_path(model_id), service.settings.render_timeout
    visited = None
    if not request.state.caller.owner:
        visited = await run_in_threadpool(service.models.get_owner, model_id) or ""
    return await forward(service.renderer, request, path, body, seconds, visited=visited)
