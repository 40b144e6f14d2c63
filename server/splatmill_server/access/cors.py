"""Web pages of other origins that may use the API (CORS): those of the setting `cors_origins`, with a key of their own.

Credentials are not allowed: a browser then sends no cookie, so that a session is of use to the server's own page alone.
"""

from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware

from splatmill.schema import CONVERSION_HEADER, DEPTH_SCALE_HEADER, EDIT_HEADER, SHA256_HEADER
from splatmill.schema.resources.uploads import UPLOAD_COMPLETE, UPLOAD_LENGTH, UPLOAD_LIMIT, UPLOAD_OFFSET
from splatmill_server.base.problems import METHODS

EXPOSED = (
    "Accept-Patch",
    "Accept-Ranges",
    "Allow",
    "Content-Disposition",
    "Content-Range",
    "ETag",
    "Idempotency-Replayed",
    "Location",
    "Retry-After",
    "WWW-Authenticate",
    "X-Request-ID",
    CONVERSION_HEADER,
    DEPTH_SCALE_HEADER,
    EDIT_HEADER,
    SHA256_HEADER,
    UPLOAD_COMPLETE,
    UPLOAD_LENGTH,
    UPLOAD_LIMIT,
    UPLOAD_OFFSET,
)
"""Headers of answers that scripts of these pages may read, beside those that browsers always show."""

_PREFLIGHT_SECONDS = 3600
"""Seconds for which a browser may remember what it was allowed. Some remember less."""


def pages_of_others(origins: list[str]) -> list[Middleware]:
    """Return the middleware that lets pages of these origins use the API, before any endpoint asks for a key."""
    if not origins:
        return []
    return [
        Middleware(
            CORSMiddleware,
            allow_origins=origins,
            allow_methods=METHODS,
            allow_headers=["*"],  # all that the page asks to send
            allow_private_network=True,
            expose_headers=EXPOSED,
            max_age=_PREFLIGHT_SECONDS,
        )
    ]
