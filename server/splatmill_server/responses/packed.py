"""Compresses responses with the cameras of a model, which have half a megabyte for a thousand photos."""

from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

LEVEL = 1
"""The level of gzip: the highest one saves a tenth more bytes, and takes several times as long."""


class PackedCameras:
    """Wraps the app. Files, those of jobs too, and streams stay as they are: they are read in parts, by their tags."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self.packing = GZipMiddleware(app, compresslevel=LEVEL)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        packs = scope["type"] == "http" and path.endswith("/cameras") and "/v1/jobs/" not in path
        await (self.packing if packs else self.app)(scope, receive, send)
