"""Passing a render request on to the renderer process, and its answer back, as a stream."""

from collections.abc import AsyncIterator

import httpx
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from splatmill_server.problems import ProblemError

_PASSED_BACK = (
    "content-type",
    "content-length",
    "content-disposition",
    "etag",
    "cache-control",
    "last-modified",
    "retry-after",
)
_OWN_PREFIX = "splatmill-"


async def forward(
    renderer: httpx.AsyncClient | None, request: Request, path: str, wish: BaseModel, seconds: float
) -> Response:
    """The renderer's answer to `wish`, whatever its status: pictures, 304 and problem documents alike.

    Raises 503 when no renderer is there, 504 when it does not answer within `seconds`.
    """
    if renderer is None:
        raise ProblemError(
            "renderer_unavailable",
            "This server has no renderer.",
            advice="Start `python -m splatmill_worker renderer` and set SPLATMILL_RENDERER_URL; "
            "models can still be downloaded.",
        )
    headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
    if (known := request.headers.get("if-none-match")) is not None:
        headers["If-None-Match"] = known
    body = wish.model_dump_json(exclude_none=True)
    try:
        answer = await renderer.send(
            renderer.build_request(
                "POST", path, content=body, headers=headers, timeout=httpx.Timeout(seconds, connect=5.0)
            ),
            stream=True,
        )
    except httpx.TimeoutException as error:
        raise ProblemError(
            "render_timeout",
            "The renderer took too long.",
            advice="Ask for a smaller picture or a shorter video, or try again when less is going on.",
        ) from error
    except httpx.TransportError as error:
        raise ProblemError(
            "renderer_unavailable",
            f"The renderer cannot be reached ({type(error).__name__}).",
            advice="Try again in a few seconds; models can still be downloaded. "
            "If it lasts, look at the log of `python -m splatmill_worker renderer`.",
            headers={"Retry-After": "5"},
        ) from error
    passed = {
        name: value
        for name, value in answer.headers.items()
        if name in _PASSED_BACK or name.startswith(_OWN_PREFIX)
    }
    if answer.status_code in (204, 304):
        await answer.aclose()
        return Response(status_code=answer.status_code, headers=passed)
    return StreamingResponse(_pass(answer), answer.status_code, passed)


async def _pass(answer: httpx.Response) -> AsyncIterator[bytes]:
    try:
        async for chunk in answer.aiter_raw():
            yield chunk
    finally:
        await answer.aclose()
