"""Requests to the renderer process, what is counted of them, and the problems of one that is missing, gone or slow."""

import asyncio
import time
from collections.abc import Mapping

import httpx
import structlog

from splatmill.backplane import rendering
from splatmill_server.base.metrics import Metrics
from splatmill_server.base.problems import ProblemError


async def post(
    renderer: httpx.AsyncClient | None, path: str, content: str, headers: Mapping[str, str], seconds: float
) -> httpx.Response:
    """Post JSON to the renderer and return its response, whatever its status, with the body still to be read.

    Raises a 503 problem if there is no renderer, and a 504 problem if it does not answer within `seconds`.
    """
    if renderer is None:
        raise no_renderer()
    try:
        sent = renderer.build_request(
            "POST",
            path,
            content=content,
            headers={
                "Content-Type": "application/json",
                "Accept-Encoding": "identity",
                **_request_id(),
                **headers,
            },
            timeout=httpx.Timeout(seconds, connect=5.0),
        )
        return await renderer.send(sent, stream=True)
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


def no_renderer() -> ProblemError:
    """Return the 503 problem of a server without a renderer."""
    return ProblemError(
        "renderer_unavailable",
        "This server has no renderer, so it cannot render images.",
        advice="Start `python -m splatmill_worker renderer` and set SPLATMILL_RENDERER_URL. "
        "Models can be downloaded without it.",
    )


def _request_id() -> dict[str, str]:
    """Return the header with the id of the request that is being answered, for the log of the renderer."""
    request_id = structlog.contextvars.get_contextvars().get("request")
    return {rendering.REQUEST_HEADER: request_id} if request_id else {}


class CountingTransport(httpx.AsyncBaseTransport):
    """Counts the requests that it passes on, by their kind and how they ended."""

    def __init__(self, transport: httpx.AsyncBaseTransport, metrics: Metrics) -> None:
        self._transport = transport
        self._metrics = metrics

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        last = request.url.path.rpartition("/")[2]
        kind = last if last in _KINDS else "other"
        if request.url.path == rendering.HEALTH:
            return await self._transport.handle_async_request(request)
        result, began = "failed", time.monotonic()
        try:
            answer = await self._transport.handle_async_request(request)
            result = _RESULTS.get(answer.status_code, "failed")
            return answer
        except asyncio.CancelledError:
            result = "abandoned"
            raise
        except httpx.TimeoutException:
            result = "timeout"
            raise
        except httpx.TransportError:
            result = "unreachable"
            raise
        finally:
            self._metrics.renders.labels(kind, result).inc()
            if result == "made":
                self._metrics.render_seconds.labels(kind).observe(time.monotonic() - began)

    async def aclose(self) -> None:
        await self._transport.aclose()


_KINDS = frozenset({"render", "orbit", "frames", "join", "convert", "edits", "mesh"})
_RESULTS = {200: "made", 204: "made", 304: "not_modified", 499: "abandoned", 503: "refused"}
