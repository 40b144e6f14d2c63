"""Requests to the renderer process, and the problems of one that is missing, gone or slow."""

from collections.abc import Mapping

import httpx

from splatmill_server.problems import ProblemError


async def post(
    renderer: httpx.AsyncClient | None, path: str, content: str, headers: Mapping[str, str], seconds: float
) -> httpx.Response:
    """Post JSON to the renderer and return its response, whatever its status, with the body still to be read.

    Raises a 503 problem if there is no renderer, and a 504 problem if it does not answer within `seconds`.
    """
    if renderer is None:
        raise ProblemError(
            "renderer_unavailable",
            "This server has no renderer, so it cannot render images.",
            advice="Start `python -m splatmill_worker renderer` and set SPLATMILL_RENDERER_URL. "
            "Models can be downloaded without it.",
        )
    try:
        sent = renderer.build_request(
            "POST",
            path,
            content=content,
            headers={"Content-Type": "application/json", "Accept-Encoding": "identity", **headers},
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
