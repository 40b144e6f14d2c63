"""Forwards render requests to the renderer process, and streams its responses back."""

import asyncio
from collections.abc import AsyncIterator, Coroutine
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from splatmill.backplane import rendering
from splatmill.schema.headers import read_token
from splatmill_server.access.caller import Caller
from splatmill_server.base import cancelling
from splatmill_server.base.renderer import post

_PASSED_BACK = (
    "content-type",
    "content-length",
    "content-disposition",
    "etag",
    "cache-control",
    "last-modified",
    "retry-after",
)
CLIENT_GONE = 499
"""Status of a response to a client that has closed its connection, which nobody reads."""

T = TypeVar("T")

_OWN_PREFIX = "splatmill-"


async def forward(
    renderer: httpx.AsyncClient | None,
    request: Request,
    path: str,
    body: BaseModel,
    seconds: float,
    *,
    visited: str | None = None,
) -> Response:
    """Post `body` to the renderer and return its response, whatever its status.

    visited: for a visitor who opened a link, the owner of the model.

    When the client closes its connection, that to the renderer is closed as well, so that it renders no further.

    Raises a 503 problem if there is no renderer, and a 504 problem if it does not answer within `seconds`.
    """
    headers = {"Content-Type": "application/json", rendering.CLIENT_HEADER: client_of(request, visited)}
    if (known := read_token(request.headers.get("if-none-match"))) is not None:
        headers["If-None-Match"] = known
    content = body.model_dump_json(exclude_none=True)
    answer = await while_connected(request, post(renderer, path, content, headers, seconds))
    if answer is None:
        return Response(status_code=CLIENT_GONE)
    passed = {
        name: value
        for name, value in answer.headers.items()
        if name in _PASSED_BACK or name.startswith(_OWN_PREFIX)
    }
    if answer.status_code in (204, 304):
        await answer.aclose()
        return Response(status_code=answer.status_code, headers=passed)
    return StreamingResponse(_pass(answer), answer.status_code, passed)


def client_of(request: Request, visited: str | None = None) -> str:
    """Return a text that stands for the caller and the machine of a request, and names neither.

    Visitors of all models of one owner take turns as one owner, apart from that owner itself.
    """
    caller = getattr(request.state, "caller", None)
    owner = caller.owner if isinstance(caller, Caller) else ""
    host = request.client.host if request.client is not None else ""
    return rendering.client_of(owner if visited is None else f"visitors of {visited}", host)


async def while_connected(request: Request, pending: Coroutine[Any, Any, T]) -> T | None:
    """Return the result of `pending`, or cancel it and return None if the client closes its connection before."""
    work = asyncio.create_task(pending)
    gone = asyncio.create_task(_disconnect(request))
    try:
        await asyncio.wait({work, gone}, return_when=asyncio.FIRST_COMPLETED)
        return await work if work.done() else None
    finally:
        await cancelling.end(work, gone)


async def _disconnect(request: Request) -> None:
    """Wait until the client closes its connection. The request's body must have been read."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _pass(answer: httpx.Response) -> AsyncIterator[bytes]:
    try:
        async for chunk in answer.aiter_raw():
            yield chunk
    finally:
        await answer.aclose()
