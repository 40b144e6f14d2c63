"""What is believed of a request that came through a proxy."""

from typing import Any

from starlette.types import Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from splatmill_server.base.root_path import HEADER

_HEADER = HEADER.lower().encode()


class TrustedProxies(ProxyHeadersMiddleware):
    """Takes a client's address and scheme from the headers of trusted proxies, and removes the header with the root
    path from requests of all others, so that what comes after this may believe it."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> Any:  # type: ignore[override]  # of ASGI, uvicorn has types of its own
        if scope["type"] == "http" and (scope.get("client") or (None,))[0] not in self.trusted_hosts:
            scope["headers"] = [(name, value) for name, value in scope["headers"] if name != _HEADER]
        await super().__call__(scope, receive, send)  # type: ignore[arg-type]  # as above
