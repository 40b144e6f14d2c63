"""The temporary folder of a request: everything in it ends with the request, however that ends."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

_KEY = "splatmill.scratch"


class ScratchMiddleware:
    """Removes the folder of a request after its response: sent, broken off, refused, or never made."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        folders: list[Path] = []
        try:
            await self._app({**scope, _KEY: folders}, receive, send)
        finally:
            for folder in folders:
                shutil.rmtree(folder, ignore_errors=True)


def scratch(request: Request) -> Path:
    """Return the temporary folder of a request, which is made the first time."""
    folders: list[Path] = request.scope[_KEY]
    if not folders:
        folders.append(Path(tempfile.mkdtemp(prefix="splatmill-render-")))
    return folders[0]
