"""The endpoints of imports: files of a capture that the server fetches from an address."""

import json
from typing import Annotated

from fastapi import APIRouter, Body, Path
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from splatmill.schema import CreateImport, Import, ImportList
from splatmill_server.access.caller import Who
from splatmill_server.requests.ownership import CaptureId
from splatmill_server.requests.parameters import JSON_ONLY
from splatmill_server.routes.openapi import JSON_BODY, problems
from splatmill_server.service import Shared
from splatmill_server.space.quota import RECORD_BYTES

router = APIRouter(prefix="/v1/captures", tags=["captures"])


@router.post(
    "/{capture_id}/import",
    status_code=202,
    responses=problems(
        "capture_not_found",
        "url_refused",
        "name_invalid",
        "too_many_requests",
        *JSON_BODY,
        "storage_full",
        "quota_exceeded",
    ),
    dependencies=[JSON_ONLY],
)
async def import_file(
    service: Shared,
    who: Who,
    response: Response,
    capture_id: CaptureId,
    request: Annotated[CreateImport, Body(examples=[{"url": "https://example.org/kitchen.zip"}])],
) -> Import:
    """Fetch a file of the capture from an address, in the background; `Location` answers how far it is."""
    owner = (await run_in_threadpool(service.captures.get_recent, capture_id)).owner
    size = RECORD_BYTES + len(json.dumps(request.url))
    async with service.quota.storing(who, owner, capture_id, size) as room:
        made = await service.imports.create(capture_id, request)
        room.stored = size
    response.headers["Location"] = f"/v1/captures/{capture_id}/imports/{made.id}"
    return made


@router.get("/{capture_id}/imports", responses=problems("capture_not_found"))
def list_imports(service: Shared, capture_id: CaptureId) -> ImportList:
    """List the imports of a capture, newest first."""
    return ImportList(imports=service.imports.list(capture_id))


@router.get("/{capture_id}/imports/{import_id}", responses=problems("capture_not_found", "import_not_found"))
def get_import(
    service: Shared, capture_id: CaptureId, import_id: Annotated[str, Path(description="Id of the import.")]
) -> Import:
    """Get an import: its state, the bytes received, and the file or the problem at its end."""
    service.captures.get(capture_id)
    return service.imports.get(capture_id, import_id)
