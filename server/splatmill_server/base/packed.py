"""Compresses responses with the cameras of a model or a job, which have half a megabyte for a thousand photos."""

from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

LEVEL = 1
"""The level of gzip: the highest one saves a tenth more bytes, and takes several times as long."""


class PackedCameras:
    """Wraps the app. Files, pictures and streams stay as they are: most are compressed, and are read in parts."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self.packing = GZipMiddleware(app, compresslevel=LEVEL)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        packs = scope["type"] == "http" and scope["path"].endswith("/cameras")
        await (self.packing if packs else self.app)(scope, receive, send)
