"""The endpoints of `/v1/bin`: what was deleted, and can be restored for a day."""

from fastapi import APIRouter
from starlette.responses import Response

from splatmill.schema import BinKind, BinList, Binned
from splatmill_server.requests.ownership import CaptureId, JobId, ListedOwner
from splatmill_server.routes.openapi import problems
from splatmill_server.service import Shared

router = APIRouter(prefix="/v1/bin", tags=["bin"])


@router.get("", responses=problems())
def list_bin(service: Shared, owner: ListedOwner) -> BinList:
    """List what is in the bin, the newest first."""
    return BinList(entries=service.bin.list(owner))


@router.put(
    "/jobs/{job_id}", responses=problems("job_not_found", "job_running", "model_in_use", "storage_full")
)
def bin_job(service: Shared, job_id: JobId) -> Binned:
    """Put a job that has ended into the bin, with its model. It is deleted for good a day later."""
    return service.bin.put_job(job_id)


@router.delete("/jobs/{job_id}", status_code=204, responses=problems("job_not_found", "not_in_bin"))
def restore_job(service: Shared, job_id: JobId) -> Response:
    """Restore a job and its model from the bin."""
    service.bin.restore(BinKind.job, job_id)
    return Response(status_code=204)


@router.put(
    "/captures/{capture_id}", responses=problems("capture_not_found", "capture_in_use", "storage_full")
)
def bin_capture(service: Shared, capture_id: CaptureId) -> Binned:
    """Put a capture into the bin. It is deleted for good a day later."""
    return service.bin.put_capture(capture_id)


@router.delete(
    "/captures/{capture_id}", status_code=204, responses=problems("capture_not_found", "not_in_bin")
)
def restore_capture(service: Shared, capture_id: CaptureId) -> Response:
    """Restore a capture from the bin."""
    service.bin.restore(BinKind.capture, capture_id)
    return Response(status_code=204)
