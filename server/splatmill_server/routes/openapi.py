"""Additions to the OpenAPI document: the problems of each endpoint, and examples."""

from typing import Any

from splatmill.schema import PROBLEM_MEDIA_TYPE, PROBLEMS, Problem

Responses = dict[int | str, dict[str, Any]]

CAPTURE_ID = "9f2b6c1d04e8a735"

CAPTURE_EXAMPLE = {
    "id": CAPTURE_ID,
    "name": "garden",
    "created_at": "2026-01-15T09:30:00Z",
    "files": [{"role": "images", "name": "0001.jpg", "size": 183402, "sha256": "5d" * 32}],
}
JOB_REQUESTS = {
    "defaults": {"summary": "All options decided from the photos", "value": {"capture": CAPTURE_ID}},
    "budget": {
        "summary": "Five minutes, at most 300,000 Gaussians",
        "value": {"capture": CAPTURE_ID, "options": {"time_budget": "5m", "max_gaussians": 300_000}},
    },
}
CAMERA: dict[str, Any] = {
    "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]],
    "width": 640,
    "height": 480,
    "fov_y_deg": 50,
}
RENDER_REQUESTS = {
    "color": {"summary": "A colour image", "value": {"camera": CAMERA}},
    "depth": {
        "summary": "16-bit depth, with the scale in a header",
        "value": {"camera": CAMERA, "output": "depth", "format": "png"},
    },
}
JSON_BODY = ("malformed_body", "unsupported_media_type", "body_too_large")
"""The problems of a body that is JSON."""

OF_MODEL = ("model_not_found", "model_not_ready")
"""The problems of what is made of a model."""

CONVERTED = (
    "model_corrupt",
    "conversion_failed",
    "quota_exceeded",
    "storage_full",
    "renderer_unavailable",
    "render_timeout",
)
"""The problems of a model in a file format of which it may have to be made first."""


def problems(*codes: str) -> Responses:
    """Return the responses for problems with these codes; codes with the same status share an entry."""
    by_status: dict[int, list[str]] = {}
    for code in (
        "unauthorized",
        "forbidden",
        "invalid_request",
        "too_many_requests",
        "queue_unavailable",
        *codes,
    ):
        by_status.setdefault(PROBLEMS[code].status, []).append(code)
    return {
        status: {
            "description": "; ".join(f"`{code}`: {PROBLEMS[code].title}" for code in named),
            "content": {
                PROBLEM_MEDIA_TYPE: {
                    "schema": {"$ref": "#/components/schemas/Problem"},
                    "examples": {
                        code: {
                            "value": Problem.of(code, PROBLEMS[code].title + ".").model_dump(
                                exclude_none=True
                            )
                        }
                        for code in named
                    },
                }
            },
        }
        for status, named in by_status.items()
    }


def example(status: int, value: Any, description: str) -> Responses:
    """Return a response with an example."""
    return {status: {"description": description, "content": {"application/json": {"example": value}}}}


def answer(status: int, description: str, **more: Any) -> Responses:
    """Return a response with this status and description."""
    return {status: {"description": description, **more}}


def binary(description: str, *media_types: str) -> Responses:
    """Return a successful response that is a file of one of these media types."""
    schema = {"type": "string", "format": "binary"}
    content = {name: {"schema": {} if name == "application/json" else schema} for name in media_types}
    return {200: {"description": description, "content": content}}
