"""One connection to a server: the API key, what is tried again, and how an answer becomes an error."""

import asyncio
import os
import random
from collections.abc import AsyncIterable, AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from splatmill.errors import ConnectionFailed, refused
from splatmill.schema.info import DEFAULT_PORT
from splatmill.schema.problems import PROBLEM_MEDIA_TYPE, Problem, code_for_status

DEFAULT_SERVER = f"http://127.0.0.1:{DEFAULT_PORT}"
SERVER_VARIABLE = "SPLATMILL_SERVER"
API_KEY_VARIABLE = "SPLATMILL_API_KEY"

# Reading waits for a render or a Redis that is coming back; connecting to a server that is there is quick.
TIMEOUT = httpx.Timeout(60.0, connect=10.0)
RETRIES = 4
FIRST_PAUSE = 0.25  # seconds; doubled each time, with jitter so that many clients do not return at once
LONGEST_PAUSE = 8.0
PASSING = frozenset({429, 502, 503, 504})
REPEATABLE = frozenset({"GET", "HEAD", "PUT", "DELETE"})

M = TypeVar("M", bound=BaseModel)

Body = Callable[[], AsyncIterable[bytes]]
"""Opens the body from its beginning, so that it can be sent again."""


class Connection:
    """Sends requests to one server.

    A request is sent again after a lost connection or a passing refusal (429, 502, 503, 504) only where repeating
    it cannot do anything twice; one that never reached the server is always sent again.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout = TIMEOUT,
        transport: httpx.AsyncBaseTransport | None = None,
        retries: int = RETRIES,
    ) -> None:
        self.server = server or os.environ.get(SERVER_VARIABLE) or DEFAULT_SERVER
        key = api_key if api_key is not None else os.environ.get(API_KEY_VARIABLE)
        url = _checked(self.server)
        headers = {"User-Agent": "splatmill", "Accept": f"application/json, {PROBLEM_MEDIA_TYPE}, */*"}
        if key:
            headers["Authorization"] = f"Bearer {key}"
        self.retries = retries
        self.http = httpx.AsyncClient(
            base_url=url,
            headers=headers,
            timeout=timeout,
            transport=transport,
            # A proxy set for the outside world must not stand between this machine and itself.
            trust_env=url.host not in ("127.0.0.1", "localhost", "::1"),
        )

    async def close(self) -> None:
        """Close the connections; the object cannot be used afterwards."""
        await self.http.aclose()

    async def request(
        self,
        method: str,
        path: str,
        *,
        json: Any = None,
        params: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
        body: Body | None = None,
        repeatable: bool | None = None,
        timeout: httpx.Timeout | None = None,
    ) -> httpx.Response:
        """The answer, read whole.

        `repeatable` says of a POST that sending it twice does no more than sending it once.
        Raises ConnectionFailed, or the `Refused` that the problem calls for.
        """
        extra: dict[str, Any] = {} if timeout is None else {"timeout": timeout}
        may_repeat = method in REPEATABLE if repeatable is None else repeatable
        tries = 0
        while True:
            tries += 1
            last = tries > self.retries
            try:
                response = await self.http.request(
                    method,
                    path,
                    json=json,
                    params=params,
                    headers=headers,
                    content=body() if body is not None else None,
                    **extra,
                )
            except httpx.TransportError as error:
                never_sent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout)
                if last or not (may_repeat or never_sent):
                    raise self.lost(error) from error
                await asyncio.sleep(pause(tries))
                continue
            if response.is_success or response.status_code == 304:
                return response
            if last or not may_repeat or response.status_code not in PASSING:
                raise refused(read_problem(response))
            await asyncio.sleep(max(pause(tries), retry_after(response)))

    @asynccontextmanager
    async def stream(
        self,
        method: str,
        path: str,
        *,
        json: Any = None,
        headers: Mapping[str, str] | None = None,
        timeout: httpx.Timeout | None = None,
    ) -> AsyncIterator[httpx.Response]:
        """One try at an answer that is read piece by piece; httpx's transport errors come through.

        Raises the `Refused` that a problem calls for.
        """
        extra: dict[str, Any] = {} if timeout is None else {"timeout": timeout}
        async with self.http.stream(method, path, json=json, headers=headers, **extra) as response:
            if not response.is_success:
                await response.aread()
                raise refused(read_problem(response))
            yield response

    def lost(self, error: httpx.TransportError) -> ConnectionFailed:
        """The error for a connection that failed."""
        reason = str(error) or type(error).__name__
        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
            return ConnectionFailed(
                f"No server answers at {self.server} ({reason}).",
                "Start one with `splatmill up`, or check the address.",
            )
        return ConnectionFailed(
            f"The connection to {self.server} was lost ({reason}).", "What was sent is kept; try again."
        )


def read_answer(kind: type[M], response: httpx.Response) -> M:
    """The answer as `kind`; ConnectionFailed for one that no Splatmill server would give."""
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise ConnectionFailed(
            f"{response.request.url} answered {response.status_code}, but not as a Splatmill server would.",
            "Check the address, and that the versions of server and client go together.",
        ) from error


def pause(tries: int) -> float:
    """Seconds to wait after the n-th try."""
    return min(FIRST_PAUSE * 2.0 ** (tries - 1), LONGEST_PAUSE) * random.uniform(0.5, 1.0)


def retry_after(response: httpx.Response) -> float:
    """Seconds the server asks to wait, at most 30; 0 where it asks for none or for a date."""
    text = response.headers.get("Retry-After", "")
    return min(float(text), 30.0) if text.isascii() and text.isdigit() else 0.0


def read_problem(response: httpx.Response) -> Problem:
    """The problem in an answer, or one made from the bare status (a proxy's page, say)."""
    if response.headers.get("Content-Type", "").startswith(PROBLEM_MEDIA_TYPE):
        try:
            return Problem.model_validate_json(response.content)
        except ValidationError:
            pass  # claimed to be one of ours and is not: treated like any other page
    status = response.status_code if 400 <= response.status_code <= 599 else 500
    made = Problem.of(
        code_for_status(status),
        f"{response.request.method} {response.request.url.path} was answered with {response.status_code} "
        f"{response.reason_phrase}, without a problem document.",
        facts={"body": response.text[:500]},
        advice="Check that the address is that of a Splatmill server.",
    )
    return made.model_copy(update={"status": status})


def _checked(server: str) -> httpx.URL:
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL as error:
        raise ValueError(f"{server!r} is no address of a server: {error}.") from error
    if url.scheme not in ("http", "https") or not url.host:
        raise ValueError(f"{server!r} is no address of a server; write it like {DEFAULT_SERVER}.")
    if url.userinfo or url.query:
        # Addresses end up in logs and histories; a key must not.
        raise ValueError(
            f"The address of a server holds no key and no query; pass api_key or set {API_KEY_VARIABLE}."
        )
    return url
