"""The HTTP connection to a server: API key, retries, and the conversion of responses into errors."""

import asyncio
import random
import ssl
from collections.abc import AsyncIterable, AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from splatmill.errors import ConnectionFailed, error_for
from splatmill.schema.headers import read_retry_after
from splatmill.schema.problems import PROBLEM_MEDIA_TYPE, Problem, code_for_status
from splatmill.transfer.server_choice import (
    API_KEY_VARIABLE,
    CA_BUNDLE_VARIABLE,
    DEFAULT_SERVER,
    Verify,
    choose_server,
    ssl_context,
)

# A read may have to wait for a render or for Redis to restart; connecting to a running server is quick.
TIMEOUT = httpx.Timeout(60.0, connect=10.0)
RETRIES = 4
FIRST_PAUSE = 0.25  # seconds; doubled after each retry, with jitter so that clients do not retry in step
LONGEST_PAUSE = 8.0  # seconds
LONGEST_WISH = 60.0
"""Longest time in seconds, named by a server in Retry-After, that a request waits for before it is sent again."""

TRANSIENT = frozenset({429, 502, 503, 504})
REPEATABLE = frozenset({"GET", "HEAD", "PUT", "DELETE"})

M = TypeVar("M", bound=BaseModel)

Body = Callable[[], AsyncIterable[bytes]]
"""Returns a new iterator over the request body, so that the body can be sent again."""


class Connection:
    """Sends requests to one server, and retries those that failed.

    A request is retried after a lost connection or a transient refusal (429, 502, 503, 504) if it is idempotent. A
    request that never reached the server is retried in any case, and so is one that was refused with 429 and a time to
    wait. When the server names a longer time than LONGEST_WISH, the request is not retried.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout = TIMEOUT,
        transport: httpx.AsyncBaseTransport | None = None,
        retries: int = RETRIES,
        profile: str | None = None,
        verify: Verify | None = None,
        headers: Mapping[str, str] | None = None,
        proxy: str | None = None,
    ) -> None:
        choice = choose_server(server, api_key=api_key, profile=profile, verify=verify, proxy=proxy)
        self.server = choice.server
        url = _checked(self.server)
        sent = {"User-Agent": "splatmill", "Accept": f"application/json, {PROBLEM_MEDIA_TYPE}, */*"}
        if choice.api_key:
            sent["Authorization"] = f"Bearer {choice.api_key}"
        self.retries = retries
        self.http = httpx.AsyncClient(
            base_url=url,
            headers=sent | dict(headers or {}),
            timeout=timeout,
            transport=transport,
            # Without TLS no certificates are needed, and to load them takes longer than a request.
            verify=ssl_context(choice.verify)
            if url.scheme == "https"
            else ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),
            proxy=choice.proxy,
            # Requests to this machine must not go through a proxy that is set for other hosts.
            trust_env=url.host not in ("127.0.0.1", "localhost", "::1"),
        )

    async def close(self) -> None:
        """Close the connections. The object cannot be used afterwards."""
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
        costly: bool = False,
    ) -> httpx.Response:
        """Send a request and return the response with its whole body.

        `repeatable` says whether the request is idempotent; left out, the method decides. A request that is `costly` is
        not repeated when it was too slow, because the server may still work on the first one.

        Raises ConnectionFailed, or the subclass of `Refused` for the problem.
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
                too_slow = costly and isinstance(error, httpx.ReadTimeout)
                if last or too_slow or not (may_repeat or never_sent):
                    raise self.lost(error) from error
                await asyncio.sleep(backoff(tries))
                continue
            if response.is_success or response.status_code == 304:
                return response
            too_slow = costly and response.status_code == 504
            wish = retry_after(response)
            unhandled = response.status_code == 429 and wish is not None
            repeats = (may_repeat or unhandled) and response.status_code in TRANSIENT
            # Without a time, it is a limit that waiting does not lift, such as that of unfinished jobs.
            repeats = repeats and (method != "POST" or response.status_code != 429 or unhandled)
            if last or too_slow or not repeats or (wish or 0.0) > LONGEST_WISH:
                raise error_for(read_problem(response), wish)
            await asyncio.sleep(max(backoff(tries), wish or 0.0))

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
        """Send a request once and yield the response, whose body is read in pieces.

        Raises httpx.TransportError, or the subclass of `Refused` for the problem.
        """
        extra: dict[str, Any] = {} if timeout is None else {"timeout": timeout}
        async with self.http.stream(method, path, json=json, headers=headers, **extra) as response:
            if not response.is_success:
                await response.aread()
                raise error_for(read_problem(response), retry_after(response))
            yield response

    def lost(self, error: httpx.TransportError) -> ConnectionFailed:
        """Return the error for a failed connection."""
        reason = str(error) or type(error).__name__
        if "CERTIFICATE_VERIFY_FAILED" in reason:
            return ConnectionFailed(
                f"The certificate of {self.server} is not trusted ({reason}).",
                f"If an authority of your own signed it, name its certificate with {CA_BUNDLE_VARIABLE} or verify=.",
            )
        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
            return ConnectionFailed(
                f"No server answers at {self.server} ({reason}).",
                "Start one with `splatmill up`, or check the address.",
            )
        return ConnectionFailed(
            f"The connection to {self.server} was lost ({reason}).",
            "The server keeps the files that it has received; try again.",
        )


def read_answer(kind: type[M], response: httpx.Response) -> M:
    """Parse the body of a response as `kind`. Raises ConnectionFailed for a body that is not one."""
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise ConnectionFailed(
            f"{response.request.url} answered {response.status_code} with a body that is not a "
            f"{kind.__name__}.",
            "Check that the address is that of a Splatmill server, and that its version fits this client.",
        ) from error


def backoff(tries: int) -> float:
    """Return the seconds to wait after the n-th attempt: exponential backoff with jitter."""
    return min(FIRST_PAUSE * 2.0 ** (tries - 1), LONGEST_PAUSE) * random.uniform(0.5, 1.0)


def retry_after(response: httpx.Response) -> float | None:
    """Return the seconds to wait that the header Retry-After names, as a number or as a date; None without it."""
    return read_retry_after(response.headers.get("Retry-After"))


def read_problem(response: httpx.Response) -> Problem:
    """Return the problem of a response; for one without a problem document (from a proxy, say), one from its status."""
    if response.headers.get("Content-Type", "").startswith(PROBLEM_MEDIA_TYPE):
        try:
            return Problem.model_validate_json(response.content)
        except ValidationError:
            pass  # the Content-Type is wrong: the body is no problem document
    status = response.status_code if 400 <= response.status_code <= 599 else 500
    made = Problem.of(
        code_for_status(status),
        f"{response.request.method} {response.request.url.path} was answered with {response.status_code} "
        f"{response.reason_phrase}, without a problem document.",
        facts={"body": response.text[:500]},
        advice="Check that the address is that of a Splatmill server.",
    )
    return made.model_copy(update={"status": status})


def own_path(server: str, address: str) -> str:
    """Return an address that an answer names without the path of the server's own: what follows `server`."""
    root = httpx.URL(server).path.rstrip("/")
    return address.removeprefix(root) if address.startswith(f"{root}/") else address


def _checked(server: str) -> httpx.URL:
    try:
        url = httpx.URL(server)
    except httpx.InvalidURL as error:
        raise ValueError(f"{server!r} is not the address of a server: {error}.") from error
    if url.scheme not in ("http", "https") or not url.host:
        raise ValueError(f"{server!r} is not the address of a server; write it like {DEFAULT_SERVER}.")
    if url.userinfo or url.query:
        # Addresses appear in logs and shell histories, where a key must not appear.
        raise ValueError(
            f"The address of the server contains credentials or a query; pass api_key or set "
            f"{API_KEY_VARIABLE}."
        )
    return url
