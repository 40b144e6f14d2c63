"""Forwards render requests to the renderer process, and streams its responses back."""

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
    renderer: httpx.AsyncClient | None, request: Request, path: str, body: BaseModel, seconds: float
) -> Response:
    """Post `body` to the renderer and return its response, whatever its status.

    Raises a 503 problem if there is no renderer, and a 504 problem if it does not answer within `seconds`.
    """
    if renderer is None:
        raise ProblemError(
            "renderer_unavailable",
            "This server has no renderer, so it cannot render images.",
            advice="Start `python -m splatmill_worker renderer` and set SPLATMILL_RENDERER_URL. "
            "Models can be downloaded without it.",
        )
    headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
    if (known := request.headers.get("if-none-match")) is not None:
        headers["If-None-Match"] = known
    content = body.model_dump_json(exclude_none=True)
    try:
        answer = await renderer.send(
            renderer.build_request(
                "POST", path, content=content, headers=headers, timeout=httpx.Timeout(seconds, connect=5.0)
            ),
            stream=True,
        )
    except httpx.TimeoutException as error:
        raise ProblemError(
            "render_timeout",
            f"The renderer did not answer within {seconds:g} seconds.",
            advice="Request a smaller image or a shorter video, or try again when the machine is less busy.",
        ) from error
    except httpx.TransportError as error:
        raise ProblemError(
            "renderer_unavailable",
            f"The renderer cannot be reached ({type(error).__name__}).",
            advice="Try again in a few seconds. If the problem persists, read the log of "
            "`python -m splatmill_worker renderer`. Models can be downloaded without it.",
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
