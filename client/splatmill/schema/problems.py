"""Problem documents (RFC 9457), and the table of all codes with their HTTP status and title.

A code keeps its meaning for ever. The same document describes a refused request and the failure of a job.
"""

from http import HTTPStatus
from typing import Any, NamedTuple

from pydantic import Field

from splatmill.schema.base import Response

PROBLEM_MEDIA_TYPE = "application/problem+json"


class Kind(NamedTuple):
    """The HTTP status and the title of a code."""

    status: int
    title: str


PROBLEMS: dict[str, Kind] = {
    # The request itself.
    "malformed_body": Kind(400, "The body could not be read"),
    "body_cut_off": Kind(400, "The body ended before its announced length"),
    "unauthorized": Kind(401, "A valid API key is required"),
    "forbidden": Kind(403, "The API key does not permit this request"),
    "origin_not_allowed": Kind(403, "A page of another address sent the request"),
    "host_not_allowed": Kind(421, "The request is addressed to a name that is not this server's"),
    "session_needs_key": Kind(401, "A session is made from an API key"),
    "not_found": Kind(404, "There is nothing at this address"),
    "method_not_allowed": Kind(405, "The address does not accept this method"),
    "body_too_large": Kind(413, "The body is larger than allowed"),
    "unsupported_media_type": Kind(415, "The content type is not accepted here"),
    "range_not_satisfiable": Kind(416, "The range lies outside the file"),
    "invalid_request": Kind(422, "The request does not fit the schema"),
    "unknown_option": Kind(422, "There is no such option"),
    "option_out_of_range": Kind(422, "An option is outside its range"),
    "camera_invalid": Kind(422, "The camera is not valid"),
    "size_out_of_range": Kind(422, "The image size is outside its range"),
    "name_invalid": Kind(422, "The file name is not accepted"),
    "url_refused": Kind(422, "The server sends no requests to this address"),
    "list_too_long": Kind(422, "The list is too long to be sorted"),
    "cursor_invalid": Kind(422, "The page cursor is not valid"),
    "upload_length_differs": Kind(400, "The upload has another length than was announced"),
    "idempotency_conflict": Kind(409, "This Idempotency-Key was used for another request"),
    "too_many_requests": Kind(429, "Too many requests"),
    "too_many_jobs": Kind(429, "Too many unfinished jobs"),
    # Resources that do not exist, do not exist yet, or are in the wrong state.
    "key_not_found": Kind(404, "There is no such API key"),
    "admin_key_needed": Kind(409, "There must be an API key with the scope admin"),
    "capture_not_found": Kind(404, "There is no such capture"),
    "job_not_found": Kind(404, "There is no such job"),
    "model_not_found": Kind(404, "There is no such model"),
    "file_not_found": Kind(404, "There is no such file"),
    "format_unknown": Kind(404, "There is no such file format of models"),
    "upload_not_found": Kind(404, "There is no such upload"),
    "upload_offset_differs": Kind(409, "The upload does not stand at this offset"),
    "upload_completed": Kind(409, "The upload is already complete"),
    "import_not_found": Kind(404, "There is no such import"),
    "orbit_not_found": Kind(404, "There is no such orbit video"),
    "mesh_not_found": Kind(404, "There is no such mesh"),
    "webhook_not_found": Kind(404, "There is no such webhook"),
    "delivery_not_found": Kind(404, "There is no such delivery"),
    "share_not_found": Kind(404, "There is no such shared link"),
    "share_ended": Kind(410, "The shared link has ended"),
    "preview_not_ready": Kind(404, "There is no preview yet"),
    "snapshot_not_ready": Kind(404, "There is no snapshot of the scene now"),
    "cameras_not_ready": Kind(404, "There are no cameras yet"),
    "report_not_ready": Kind(404, "There is no report yet"),
    "model_not_ready": Kind(409, "The model is not finished yet"),
    "orbit_not_ready": Kind(409, "The orbit video is not whole yet"),
    "too_many_orbits": Kind(409, "There are too many orbit videos"),
    "mesh_not_ready": Kind(409, "The mesh is not whole yet"),
    "too_many_meshes": Kind(409, "There are too many meshes"),
    "name_taken": Kind(409, "Another file is stored under this name"),
    "capture_in_use": Kind(409, "A job is using this capture"),
    "model_in_use": Kind(409, "A job starts from this model"),
    "not_in_bin": Kind(404, "It is not in the bin"),
    "job_running": Kind(409, "The job is still running"),
    "job_finished": Kind(409, "The job has already ended"),
    # The uploaded files.
    "digest_mismatch": Kind(422, "The bytes do not have the announced digest"),
    "file_empty": Kind(422, "The file is empty"),
    "import_failed": Kind(502, "The other server did not deliver the file"),
    "not_an_image": Kind(422, "The file is not an image that can be read"),
    "image_truncated": Kind(422, "The image file is incomplete"),
    "decoder_ended": Kind(500, "The process that decodes a file was ended"),
    "image_too_small": Kind(422, "The image is too small"),
    "image_too_large": Kind(422, "The image has too many pixels"),
    "archive_bomb": Kind(422, "The archive would unpack to too much data"),
    "video_unreadable": Kind(422, "The video cannot be read"),
    "no_images": Kind(422, "There are no images"),
    "too_few_images": Kind(422, "There are too few images"),
    "poses_invalid": Kind(422, "The camera poses that came with the photos cannot be used"),
    "start_unusable": Kind(422, "The model to start from cannot be used"),
    "holdout_empty": Kind(422, "The choice of held-out photos cannot be used"),
    # Structure from motion.
    "sfm_no_features": Kind(422, "The photos have too few features to match"),
    "sfm_too_few_registered": Kind(422, "Too few photos could be registered"),
    "sfm_no_parallax": Kind(422, "The photos have no parallax: the camera turned but did not move"),
    "sfm_failed": Kind(422, "The cameras could not be recovered"),
    # Training.
    "backend_unavailable": Kind(422, "The chosen backend does not run on this machine"),
    "non_finite": Kind(500, "The optimisation produced values that are not finite"),
    "diverged": Kind(500, "The optimisation diverged"),
    "empty_scene": Kind(500, "No Gaussians were left in the scene"),
    "out_of_memory": Kind(500, "The machine ran out of memory"),
    "run_time_exceeded": Kind(500, "The job ran longer than the worker allows"),
    # The service itself.
    "worker_lost": Kind(500, "The worker ended without reporting a result"),
    "attempts_exhausted": Kind(500, "Every attempt at the job ended early"),
    "render_failed": Kind(500, "The image could not be rendered"),
    "mesh_failed": Kind(500, "The mesh could not be made"),
    "conversion_failed": Kind(500, "The model could not be converted"),
    "capture_incomplete": Kind(500, "Not all files of the capture reached the training"),
    "job_corrupt": Kind(500, "The stored record of the job cannot be read"),
    "model_corrupt": Kind(500, "The stored model cannot be read"),
    "internal_error": Kind(500, "The service failed to handle the request"),
    "too_many_followers": Kind(503, "Too many clients follow events"),
    "lists_not_ready": Kind(503, "The lists are being made"),
    "queue_unavailable": Kind(503, "The job queue cannot be reached"),
    "storage_unavailable": Kind(503, "The storage cannot be reached"),
    "renderer_unavailable": Kind(503, "The renderer cannot be reached"),
    "render_timeout": Kind(504, "The renderer did not answer in time"),
    "worker_disk_full": Kind(507, "The disk of the worker is almost full"),
    "storage_full": Kind(507, "The storage is full"),
    "quota_exceeded": Kind(507, "The owner has no room left in storage"),
    "storage_unwritable": Kind(507, "The storage cannot be written to"),
}


class Problem(Response):
    """Why a request was refused or a job failed (RFC 9457, with `code`, `facts` and `advice` added)."""

    type: str = Field(default="about:blank", description="URN of the kind of problem.")
    title: str = Field(description="The kind of problem; the same for all problems with this code.")
    status: int = Field(ge=400, le=599, description="The HTTP status.")
    detail: str = Field(description="What happened, and what was seen.")
    instance: str | None = Field(
        default=None, description="Path of the request, or the job, that the problem belongs to."
    )
    code: str = Field(description="Stable name of the kind of problem, for programs.")
    facts: dict[str, Any] = Field(
        default_factory=dict, description="The numbers and names that the detail is based on."
    )
    advice: str | None = Field(default=None, description="What to do.")

    @classmethod
    def of(
        cls,
        code: str,
        detail: str,
        *,
        facts: dict[str, Any] | None = None,
        advice: str | None = None,
        instance: str | None = None,
    ) -> "Problem":
        """Return a problem whose title and status come from the table. Raises KeyError for an unknown code."""
        kind = PROBLEMS[code]
        return cls(
            type=f"urn:splatmill:problem:{code}",
            title=kind.title,
            status=kind.status,
            detail=detail,
            instance=instance,
            code=code,
            facts=facts or {},
            advice=advice,
        )

    @property
    def sentence(self) -> str:
        """The detail, followed by the advice where there is some."""
        return f"{self.detail} {self.advice}" if self.advice else self.detail


def code_for_status(status: int) -> str:
    """Return the general code for an HTTP status, for a response without a problem document."""
    general: dict[int, str] = {
        HTTPStatus.BAD_REQUEST: "malformed_body",
        HTTPStatus.UNAUTHORIZED: "unauthorized",
        HTTPStatus.FORBIDDEN: "forbidden",
        HTTPStatus.NOT_FOUND: "not_found",
        HTTPStatus.METHOD_NOT_ALLOWED: "method_not_allowed",
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE: "body_too_large",
        HTTPStatus.UNSUPPORTED_MEDIA_TYPE: "unsupported_media_type",
        HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE: "range_not_satisfiable",
        HTTPStatus.TOO_MANY_REQUESTS: "too_many_requests",
        HTTPStatus.BAD_GATEWAY: "queue_unavailable",
        HTTPStatus.SERVICE_UNAVAILABLE: "queue_unavailable",
        HTTPStatus.GATEWAY_TIMEOUT: "render_timeout",
        HTTPStatus.INSUFFICIENT_STORAGE: "storage_full",
    }
    return general.get(status, "invalid_request" if status < 500 else "internal_error")
