"""The endpoints of `/v1/captures`: photos, masks and poses that belong together."""

from typing import Annotated

from fastapi import APIRouter, Body, Header, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from splatmill.schema import SHA256_HEADER, Capture, CaptureFile, CapturePage, CreateCapture, Role, safe_name
from splatmill.schema.headers import read_integer
from splatmill.schema.resources.uploads import UPLOAD_COMPLETE, UPLOAD_LENGTH, read_boolean
from splatmill_server.access.caller import Who
from splatmill_server.base.filters import Filter
from splatmill_server.base.paging import DEFAULT_LIMIT
from splatmill_server.base.problems import ProblemError
from splatmill_server.requests.ownership import CaptureId, ListedOwner
from splatmill_server.requests.parameters import JSON_ONLY, Cursor, Limit, NamePart
from splatmill_server.routes import uploads
from splatmill_server.routes.openapi import CAPTURE_EXAMPLE, JSON_BODY, answer, example, problems
from splatmill_server.service import Shared
from splatmill_server.space.quota import CAPTURE_BYTES, bytes_beside

router = APIRouter(prefix="/v1/captures", tags=["captures"])

_ACCEPTED = {
    Role.images: ("image/", "video/", "application/zip", "application/x-zip", "application/octet-stream"),
    Role.masks: ("image/", "application/octet-stream"),
    Role.poses: ("application/json", "text/plain", "application/octet-stream"),
}


@router.post(
    "",
    status_code=201,
    responses=problems(*JSON_BODY, "storage_full", "quota_exceeded")
    | answer(200, "The capture that an earlier request with the same `key` has made", model=Capture)
    | example(201, CAPTURE_EXAMPLE | {"files": []}, "The new, empty capture"),
    dependencies=[JSON_ONLY],
)
async def create_capture(
    service: Shared,
    who: Who,
    response: Response,
    request: Annotated[CreateCapture | None, Body(examples=[{"name": "garden"}])] = None,
) -> Capture:
    """Create an empty capture. Its files are uploaded one by one afterwards."""
    asked = request or CreateCapture()
    capture, new = await run_in_threadpool(
        lambda: service.captures.create(asked.name, owner=who.owner, key=asked.key)
    )
    if new:
        try:
            size = len(capture.model_dump_json().encode()) + CAPTURE_BYTES
            async with service.quota.storing(who, who.owner, capture.id, size) as room:
                room.stored = size
        except Exception:
            await run_in_threadpool(service.deletion.unused_capture, capture)
            raise
    response.headers["Location"] = f"/v1/captures/{capture.id}"
    if not new:
        response.status_code = 200
        return await service.captures.get_with_files(capture.id)
    return capture


@router.get("", responses=problems("cursor_invalid", "lists_not_ready"))
def list_captures(
    service: Shared,
    owner: ListedOwner,
    cursor: Cursor = None,
    limit: Limit = DEFAULT_LIMIT,
    name: NamePart = None,
) -> CapturePage:
    """List captures, newest first, without their files."""
    return service.captures.list(cursor, limit, Filter(owner, name))


@router.get(
    "/{capture_id}",
    responses=problems("capture_not_found") | example(200, CAPTURE_EXAMPLE, "The capture with its files"),
)
async def get_capture(service: Shared, capture_id: CaptureId) -> Capture:
    """Get a capture with its files and their digests."""
    return await service.captures.get_with_files(capture_id)


@router.delete("/{capture_id}", status_code=204, responses=problems("capture_not_found", "capture_in_use"))
def delete_capture(service: Shared, capture_id: CaptureId) -> Response:
    """Delete a capture and its files, unless an unfinished job uses it."""
    service.deletion.capture(capture_id)
    return Response(status_code=204)


@router.put(
    "/{capture_id}/{role}/{name:path}",
    status_code=201,
    response_model=CaptureFile,
    responses=answer(200, "The same bytes were already stored", model=CaptureFile)
    | uploads.CREATED
    | problems(
        "capture_not_found",
        "name_taken",
        "upload_offset_differs",
        "name_invalid",
        "file_empty",
        "digest_mismatch",
        "body_cut_off",
        "body_too_large",
        "unsupported_media_type",
        "storage_full",
        "quota_exceeded",
        "too_many_requests",
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "The bytes of the file, not encoded.",
            "content": {
                name: {"schema": {"type": "string", "format": "binary"}}
                for name in ("application/octet-stream", "image/jpeg", "image/png")
            },
        }
    },
)
async def put_file(
    service: Shared,
    who: Who,
    request: Request,
    capture_id: CaptureId,
    role: Role,
    name: Annotated[str, Path(description="Relative path with '/', unique within the role.")],
    digest: Annotated[
        str | None,
        Header(alias=SHA256_HEADER, description="SHA-256 of the bytes in hex; checked if given."),
    ] = None,
    complete: Annotated[
        str | None,
        Header(
            alias=UPLOAD_COMPLETE,
            description="`?0` begins an upload in several requests; the body may be empty, or the first bytes.",
        ),
    ] = None,
    total: Annotated[
        str | None,
        Header(alias=UPLOAD_LENGTH, description="With `Upload-Complete: ?0`, the size of the file."),
    ] = None,
) -> Response:
    """Upload a file. The same bytes may be sent again; other bytes under the same name are refused.

    With `Upload-Complete: ?0`, the file arrives in several requests, and can be continued after a break. The same file
    (name, `Upload-Length` and digest) is then the same upload, and `Upload-Offset` is where to continue.
    """
    media_type = (
        request.headers.get("content-type", "application/octet-stream").partition(";")[0].strip().lower()
    )
    if not media_type.startswith(_ACCEPTED[role]):
        raise ProblemError(
            "unsupported_media_type",
            f"The content type {media_type[:80]!r} is not accepted for {role.value}/{name[:200]}.",
            advice="Send the bytes of the file with Content-Type: application/octet-stream.",
            facts={"accepted": list(_ACCEPTED[role])},
        )
    if read_boolean(complete) is False:
        return await uploads.begin(service, who, request, capture_id, role, name, digest, total)
    size = read_integer(request.headers.get("content-length"))
    name = safe_name(name)
    async with service.quota.upload(
        who,
        capture_id,
        size,
        file=f"{role.value}/{name}",
        beside=bytes_beside(name),
        is_stored=lambda: service.captures.digests.of(capture_id, role, name) is not None,
    ) as arrival:
        file, new = await service.captures.save_file(
            capture_id,
            role,
            name,
            arrival.counted(request.stream()),
            announced_sha256=digest,
            announced_size=size,
        )
        arrival.stored = file.size if new else 0
    return JSONResponse(
        file.model_dump(mode="json"), 201 if new else 200, headers={SHA256_HEADER: file.sha256}
    )
