"""RFC 9457 problem documents, and the one table of stable codes with their status and title.

A code never changes its meaning. The same document describes a refused request and the reason a job failed.
"""

from http import HTTPStatus
from typing import Any, NamedTuple

from pydantic import Field

from splatmill.schema.base import Response

PROBLEM_MEDIA_TYPE = "application/problem+json"


class Kind(NamedTuple):
    """What a code stands for: the HTTP status it is answered with and its title."""

    status: int
    title: str


PROBLEMS: dict[str, Kind] = {
    # The request as such.
    "malformed_body": Kind(400, "The body could not be read"),
    "body_cut_off": Kind(400, "The body ended before its announced length"),
    "unauthorized": Kind(401, "An API key is needed"),
    "forbidden": Kind(403, "This API key may not do that"),
    "not_found": Kind(404, "There is nothing at this address"),
    "method_not_allowed": Kind(405, "This address does not take that method"),
    "body_too_large": Kind(413, "The body is larger than allowed"),
    "unsupported_media_type": Kind(415, "This content type is not accepted here"),
    "range_not_satisfiable": Kind(416, "The range lies outside the file"),
    "invalid_request": Kind(422, "The request does not fit the schema"),
    "unknown_option": Kind(422, "There is no such option"),
    "option_out_of_range": Kind(422, "An option is outside its range"),
    "camera_invalid": Kind(422, "The camera cannot be rendered from"),
    "size_out_of_range": Kind(422, "The picture size is outside its range"),
    "name_invalid": Kind(422, "The file name is not accepted"),
    "cursor_invalid": Kind(422, "The page cursor is not one of ours"),
    "idempotency_conflict": Kind(409, "This Idempotency-Key was used for another request"),
    "too_many_requests": Kind(429, "Too many requests"),
    # Things that are not there, not yet there, or not in the right state.
    "capture_not_found": Kind(404, "There is no such capture"),
    "job_not_found": Kind(404, "There is no such job"),
    "model_not_found": Kind(404, "There is no such model"),
    "file_not_found": Kind(404, "There is no such file"),
    "preview_not_ready": Kind(404, "There is no preview yet"),
    "report_not_ready": Kind(404, "There is no report yet"),
    "model_not_ready": Kind(409, "The model is not finished yet"),
    "name_taken": Kind(409, "Another file is stored under this name"),
    "capture_in_use": Kind(409, "A job is using this capture"),
    "job_running": Kind(409, "The job is still running"),
    "job_finished": Kind(409, "The job has already ended"),
    # What was uploaded.
    "digest_mismatch": Kind(422, "The bytes do not have the announced digest"),
    "file_empty": Kind(422, "The file is empty"),
    "not_an_image": Kind(422, "The file is not an image that can be read"),
    "image_truncated": Kind(422, "The image ends before its data do"),
    "image_too_small": Kind(422, "The image is too small"),
    "image_too_large": Kind(422, "The image has too many pixels"),
    "archive_invalid": Kind(422, "The archive cannot be read"),
    "archive_unsafe": Kind(422, "The archive holds names that lead outside of it"),
    "archive_bomb": Kind(422, "The archive unpacks to far more than it should"),
    "video_unreadable": Kind(422, "The video cannot be read"),
    "no_images": Kind(422, "There are no images"),
    "too_few_images": Kind(422, "There are too few images"),
    "poses_invalid": Kind(422, "The camera poses that came with the images cannot be used"),
    "start_unusable": Kind(422, "The model to start from cannot be used"),
    "holdout_empty": Kind(422, "Holding out these views leaves nothing to train on"),
    # Structure from motion.
    "sfm_no_features": Kind(422, "The photos show too little detail to match"),
    "sfm_too_few_registered": Kind(422, "Too few photos could be placed"),
    "sfm_no_parallax": Kind(422, "The camera turned but did not move"),
    "sfm_failed": Kind(422, "The camera positions could not be recovered"),
    # Training.
    "backend_unavailable": Kind(422, "The chosen backend does not run on this machine"),
    "budget_too_small": Kind(422, "The budget is too small to train anything"),
    "non_finite": Kind(500, "The optimisation left the finite numbers"),
    "diverged": Kind(500, "The optimisation diverged"),
    "empty_scene": Kind(500, "No Gaussian was left in the scene"),
    "out_of_memory": Kind(500, "The machine ran out of memory"),
    # The service itself.
    "worker_lost": Kind(500, "The worker ended without a word"),
    "attempts_exhausted": Kind(500, "The job was tried as often as allowed"),
    "render_failed": Kind(500, "The view could not be rendered"),
    "model_corrupt": Kind(500, "The stored model cannot be read"),
    "internal_error": Kind(500, "The service made a mistake"),
    "queue_unavailable": Kind(503, "The job queue cannot be reached"),
    "storage_unavailable": Kind(503, "The storage cannot be reached"),
    "renderer_unavailable": Kind(503, "The renderer cannot be reached"),
    "render_timeout": Kind(504, "The renderer took too long"),
    "storage_full": Kind(507, "The storage is full"),
    "storage_unwritable": Kind(507, "The storage cannot be written to"),
}


class Problem(Response):
    """A refused request, or why a job failed (RFC 9457, with `code`, `facts` and `advice` added)."""

    type: str = Field(default="about:blank", description="An address that names the kind of problem.")
    title: str = Field(description="The kind of problem, the same for every one with this code.")
    status: int = Field(ge=400, le=599, description="The HTTP status.")
    detail: str = Field(description="What happened and what was seen, in a sentence.")
    instance: str | None = Field(default=None, description="The request or job this happened to.")
    code: str = Field(description="A stable name for programs to decide on.")
    facts: dict[str, Any] = Field(
        default_factory=dict, description="The numbers and names behind the detail."
    )
    advice: str | None = Field(default=None, description="What to do about it.")

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
        """The problem with `code` from the table; KeyError for a code that is not in it."""
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
        """Detail and advice as one text for people."""
        return f"{self.detail} {self.advice}" if self.advice else self.detail


def code_for_status(status: int) -> str:
    """The general code for a bare HTTP status, for answers that no code of ours was raised for."""
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
