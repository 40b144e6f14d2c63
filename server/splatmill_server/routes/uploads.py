"""The endpoints of uploads in several requests: how far one is, the next bytes, and cancellation.

An upload begins with `PUT /v1/captures/{id}/{role}/{name}` and the header `Upload-Complete: ?0`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import APIRouter, Header, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from splatmill.schema import SHA256_HEADER, CaptureFile, Role
from splatmill.schema.headers import read_integer
from splatmill.schema.resources.uploads import (
    PARTIAL_UPLOAD,
    UPLOAD_COMPLETE,
    UPLOAD_LENGTH,
    UPLOAD_LIMIT,
    UPLOAD_OFFSET,
    read_boolean,
    write_boolean,
)
from splatmill_server.access.caller import Caller, Who
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.partial_uploads import Standing
from splatmill_server.captures.records import STALE_SECONDS
from splatmill_server.requests.ownership import CaptureId
from splatmill_server.routes.openapi import Responses, answer, problems
from splatmill_server.service import Service, Shared
from splatmill_server.space.quota import RECORD_BYTES, bytes_beside

router = APIRouter(prefix="/v1/captures", tags=["captures"])

UploadId = Annotated[str, Path(description="Id of the upload, from the `Location` of its creation.")]


def _fields(*names: str) -> dict[str, dict[str, object]]:
    described = {
        UPLOAD_COMPLETE: "`?1` once all bytes have arrived, else `?0`.",
        UPLOAD_OFFSET: "Number of bytes that the server holds.",
        UPLOAD_LENGTH: "Size of the whole file, where it is known.",
        UPLOAD_LIMIT: "`max-size` in bytes, and `max-age`, the seconds until an upload is deleted if it is left.",
        "Location": "Address of the upload.",
    }
    return {name: {"schema": {"type": "string"}, "description": described[name]} for name in names}


CREATED: Responses = answer(
    201,
    "The file is stored; or, with `Upload-Complete: ?0`, an upload has begun, and `Location` is its address",
    headers=_fields("Location", UPLOAD_COMPLETE, UPLOAD_OFFSET, UPLOAD_LIMIT),
    model=CaptureFile | None,
)


async def begin(
    service: Service,
    who: Caller,
    request: Request,
    capture_id: str,
    role: Role,
    name: str,
    digest: str | None,
    length: str | None,
) -> Response:
    """Begin an upload, with the first bytes if the request has a body; answer with its address."""
    with _limits_on_413(service):
        owner = (await run_in_threadpool(service.captures.get_recent, capture_id)).owner
        async with service.quota.storing(who, owner, capture_id, RECORD_BYTES) as room:
            standing = await service.partial_uploads.create(
                capture_id, role, name, read_integer(length), digest
            )
            room.stored = (
                len(standing.record.model_dump_json().encode()) if isinstance(standing, Standing) else 0
            )
        if isinstance(standing, CaptureFile):
            return _stored(standing, 200)
        try:
            missing = max((standing.record.length or 0) - standing.offset, 0)
            await run_in_threadpool(service.quota.check_new, who, capture_id, missing)
        except ProblemError:
            if not standing.offset:
                await service.partial_uploads.cancel(capture_id, standing.record.id)
            raise
        address = {"Location": f"/v1/captures/{capture_id}/uploads/{standing.record.id}"}
        size = read_integer(request.headers.get("content-length"))
        if size or (size is None and "transfer-encoding" in request.headers):
            try:
                async with service.quota.upload(who, capture_id, size, keeps_parts=True) as arrival:
                    standing, _, _ = await service.partial_uploads.append(
                        capture_id,
                        standing.record.id,
                        arrival.counted(request.stream()),
                        offset=0,
                        complete=False,
                        body_size=size,
                    )
            except ProblemError as error:
                error.headers = {**(error.headers or {}), **address}
                raise
    return Response(status_code=201, headers=_state(service, standing) | address)


@router.options("/{capture_id}/{role}/{name:path}", status_code=204, responses=problems("capture_not_found"))
def get_upload_limits(service: Shared, capture_id: CaptureId, role: Role, name: str) -> Response:
    """Tell that files can be uploaded in several requests, and the limits."""
    service.captures.get(capture_id)
    headers = {"Accept-Patch": PARTIAL_UPLOAD, "Allow": "PUT, OPTIONS", UPLOAD_LIMIT: _limits(service)}
    return Response(status_code=204, headers=headers)


@router.head(
    "/{capture_id}/uploads/{upload_id}",
    status_code=204,
    responses=answer(
        204,
        "How far the upload is",
        headers=_fields(UPLOAD_COMPLETE, UPLOAD_OFFSET, UPLOAD_LENGTH, UPLOAD_LIMIT),
    )
    | problems("capture_not_found", "upload_not_found"),
)
async def get_upload(service: Shared, capture_id: CaptureId, upload_id: UploadId) -> Response:
    """Get the number of bytes that the server holds. A request that still appends to the upload is ended."""
    standing = await service.partial_uploads.standing(capture_id, upload_id)
    return Response(status_code=204, headers=_state(service, standing) | {"Cache-Control": "no-store"})


@router.patch(
    "/{capture_id}/uploads/{upload_id}",
    response_model=CaptureFile,
    status_code=201,
    responses=answer(200, "The same bytes were already stored", model=CaptureFile)
    | answer(201, "All bytes have arrived, and the file is stored", model=CaptureFile)
    | answer(204, "The bytes were appended", headers=_fields(UPLOAD_COMPLETE, UPLOAD_OFFSET, UPLOAD_LIMIT))
    | problems(
        "capture_not_found",
        "upload_not_found",
        "upload_offset_differs",
        "upload_length_differs",
        "upload_completed",
        "unsupported_media_type",
        "name_taken",
        "file_empty",
        "digest_mismatch",
        "body_cut_off",
        "body_too_large",
        "storage_full",
        "quota_exceeded",
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The next bytes of the file.",
            "content": {PARTIAL_UPLOAD: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def append_to_upload(
    service: Shared,
    who: Who,
    request: Request,
    capture_id: CaptureId,
    upload_id: UploadId,
    offset: Annotated[
        str | None, Header(alias=UPLOAD_OFFSET, description="Position of the first byte in the file.")
    ] = None,
    complete: Annotated[
        str | None, Header(alias=UPLOAD_COMPLETE, description="`?1` if the body ends the file, else `?0`.")
    ] = None,
    length: Annotated[str | None, Header(alias=UPLOAD_LENGTH, description="Size of the whole file.")] = None,
) -> Response:
    """Append bytes to an upload. What arrives of a body that breaks off is kept.

    The bytes must begin where the upload ends. The last request, with `Upload-Complete: ?1`, checks the SHA-256 over
    the whole file and stores it.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != PARTIAL_UPLOAD:
        raise ProblemError(
            "unsupported_media_type",
            f"An upload is continued with {PARTIAL_UPLOAD}; the content type is {media_type[:80] or 'missing'!r}.",
            advice=f"Send the header 'Content-Type: {PARTIAL_UPLOAD}'.",
        )
    at, last = read_integer(offset), read_boolean(complete)
    if at is None or last is None:
        missing = UPLOAD_OFFSET if at is None else UPLOAD_COMPLETE
        raise ProblemError(
            "invalid_request",
            f"The header {missing} is missing or has another form.",
            advice="Send Upload-Offset with a number of bytes, and Upload-Complete with ?0, or ?1 for the last bytes.",
        )
    size = read_integer(request.headers.get("content-length"))
    with _limits_on_413(service):
        beside = bytes_beside("") if last else 0
        async with service.quota.upload(who, capture_id, size, beside=beside, keeps_parts=True) as arrival:
            standing, file, new = await service.partial_uploads.append(
                capture_id,
                upload_id,
                arrival.counted(request.stream()),
                offset=at,
                complete=last,
                length=read_integer(length),
                body_size=size,
            )
            arrival.beside = bytes_beside(file.name) if file is not None else 0
            if file is not None and not new:
                arrival.stored = 0  # its bytes were there already, and those that arrived are deleted
    if file is None:
        return Response(status_code=204, headers=_state(service, standing))
    return _stored(file, 201 if new else 200)


@router.delete(
    "/{capture_id}/uploads/{upload_id}",
    status_code=204,
    responses=problems("capture_not_found", "upload_not_found"),
)
async def cancel_upload(service: Shared, capture_id: CaptureId, upload_id: UploadId) -> Response:
    """Cancel an upload, and delete the bytes that have arrived. A file that is already stored stays."""
    await service.partial_uploads.cancel(capture_id, upload_id)
    return Response(status_code=204)


def _stored(file: CaptureFile, status: int) -> Response:
    headers = {
        SHA256_HEADER: file.sha256,
        UPLOAD_COMPLETE: write_boolean(True),
        UPLOAD_OFFSET: str(file.size),
    }
    return JSONResponse(file.model_dump(mode="json"), status, headers=headers)


def _state(service: Service, standing: Standing) -> dict[str, str]:
    headers = {
        UPLOAD_OFFSET: str(standing.offset),
        UPLOAD_COMPLETE: write_boolean(standing.record.stored is not None),
        UPLOAD_LIMIT: _limits(service, standing.seconds_left),
    }
    length = standing.record.length
    return headers | ({} if length is None else {UPLOAD_LENGTH: str(length)})


def _limits(service: Service, seconds_left: int = STALE_SECONDS) -> str:
    return f"max-size={service.settings.max_file_bytes}, max-age={seconds_left}"


@contextmanager
def _limits_on_413(service: Service) -> Iterator[None]:
    """Add the limits to the answer to a file that exceeds them."""
    try:
        yield
    except ProblemError as error:
        if error.status_code == 413:
            error.headers = {**(error.headers or {}), UPLOAD_LIMIT: _limits(service)}
        raise
