"""The middleware before all endpoints: request id, API key, size limit of bodies, metrics and access log.

It is plain ASGI, because Starlette's BaseHTTPMiddleware buffers streams.
"""

import logging
import time
import uuid
from collections.abc import Awaitable, Callable
from urllib.parse import quote

import redis
import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from splatmill.backplane.storage.storage import StorageError
from splatmill.schema import Problem, format_bytes
from splatmill.schema.headers import read_integer
from splatmill_server.access.caller import NOBODY, Caller
from splatmill_server.access.permission import is_open
from splatmill_server.base.problems import (
    ProblemError,
    ProblemResponse,
    for_people,
    problem_of_redis,
    problem_of_storage,
    shown_path,
)
from splatmill_server.base.root_path import HEADER, locate, location, own_path
from splatmill_server.service import Service

log = structlog.get_logger()

PROBES = frozenset({"/healthz", "/readyz"})
"""Paths that probes request every few seconds, and that are left out of the access log."""


class RequestMiddleware:
    """Wraps the app."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self.app = app
        self.authentication = service.authentication
        self.rate = service.rate
        self.root_path = service.settings.root_path
        self.max_body = service.settings.max_json_bytes
        self.metrics = service.metrics
        self.level = logging.INFO if service.settings.access_log else logging.DEBUG

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begun, status, sent = time.perf_counter(), 500, 0
        headers = Headers(scope=scope)
        request_id = headers.get("x-request-id", "")
        if not (request_id.isascii() and request_id.isprintable() and 0 < len(request_id) <= 64):
            request_id = uuid.uuid4().hex[:16]

        async def send_marked(message: Message) -> None:
            nonlocal status, sent
            sent += len(message.get("body", b""))
            if message["type"] == "http.response.start":
                status = message["status"]
                marked = MutableHeaders(scope=message)
                marked["X-Request-ID"] = request_id
                marked["X-Content-Type-Options"] = "nosniff"
                if "location" in marked:
                    marked["Location"] = location(scope, marked["Location"])
            await send(message)

        scope.setdefault("state", {})["caller"] = NOBODY
        try:
            with structlog.contextvars.bound_contextvars(request=request_id):
                try:
                    await self._admit(scope, headers)
                except ProblemError as refused:
                    await _refusal(refused, scope, headers)(scope, receive, send_marked)
                else:
                    await self._answer(scope, self._bounded(scope, headers, receive), send_marked)
        finally:
            seconds = time.perf_counter() - begun
            # The route template in place of the path: otherwise each id would be a time series of its own.
            route = getattr(scope.get("route"), "path", None)
            self.metrics.request(scope["method"], route, status, seconds)
            caller: Caller = scope["state"]["caller"]
            level = logging.DEBUG if own_path(scope) in PROBES else self.level
            log.log(
                logging.WARNING if status >= 500 else level,
                "request",
                request=request_id,
                owner=caller.owner,
                key=caller.key_name,
                method=scope["method"][:16],
                path=shown_path(scope),
                status=status,
                seconds=round(seconds, 4),
                bytes=sent,
                **_job_of(scope),
            )

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Call the app; an unexpected exception becomes a problem document and a traceback in the log."""
        begun = False

        async def send_noted(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(scope, receive, send_noted)
        except ClientDisconnect:
            log.debug("the client disconnected", path=shown_path(scope))
        except Exception as error:
            log.exception("unexpected error", method=scope["method"], path=shown_path(scope))
            if begun:
                raise  # The status is already sent, so only a broken connection shows that the rest is missing.
            problem = Problem.of(
                "internal_error",
                f"The service failed to handle {scope['method']} {scope['path']} because of an "
                f"unexpected error.",
                advice="Find the X-Request-ID of this response in the server's log, and report the "
                "error shown there.",
                facts={"kind": type(error).__name__},
            )
            await ProblemResponse(problem, scope["path"])(scope, receive, send)

    async def _admit(self, scope: Scope, headers: Headers) -> None:
        """Find the caller. Raises ProblemError for a request that is refused before its body is read."""
        try:
            locate(scope, headers, self.root_path)
        except ValueError as error:
            raise ProblemError(
                "invalid_request",
                f"The header {HEADER}, which the proxy before the server has sent, cannot be used: {error}.",
                advice="Let the proxy set it to the path below which it publishes the server, or set "
                "SPLATMILL_ROOT_PATH.",
            ) from error
        if not is_open(own_path(scope)):
            try:
                scope["state"]["caller"] = await self.authentication.caller(scope, headers)
            except StorageError as error:
                log.warning("keys cannot be read", error=str(error))
                problem = problem_of_storage(error)
                raise ProblemError(problem.code, problem.detail, advice=problem.advice) from error
            except redis.RedisError as error:
                log.warning("sessions cannot be read", error=str(error))
                problem = problem_of_redis(error, admin=False)
                raise ProblemError(
                    problem.code, problem.detail, advice=problem.advice, headers={"Retry-After": "5"}
                ) from error
            await self.rate.admit(scope["state"]["caller"])
        length = read_integer(headers.get("content-length")) or 0
        if not _streams(scope, headers) and length > self.max_body:
            raise self._too_large(length)

    def _bounded(self, scope: Scope, headers: Headers, receive: Receive) -> Callable[[], Awaitable[Message]]:
        """Return a `receive` that raises a 413 problem once a body without Content-Length grows too large."""
        if _streams(scope, headers):
            return receive
        received = 0

        async def bounded() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self.max_body:
                raise self._too_large(received)
            return message

        return bounded

    def _too_large(self, size: int) -> ProblemError:
        return ProblemError(
            "body_too_large",
            f"The body has {format_bytes(size)} or more; at most {format_bytes(self.max_body)} "
            f"are accepted here.",
            advice="Upload files one by one with PUT /v1/captures/{id}/images/{name}.",
            facts={"limit": self.max_body},
        )


def _refusal(refused: ProblemError, scope: Scope, headers: Headers) -> Response:
    """The answer to a refused request; somebody without a session who asks for a page is led to the sign-in page."""
    if refused.problem.status == 401 and for_people(scope, headers):
        return RedirectResponse(f"/sign-in?next={quote(scope['path'])}", 303)
    return ProblemResponse(refused.problem, scope["path"], refused.headers)


def _job_of(scope: Scope) -> dict[str, str]:
    """Return the field that names the job of a request whose address names one."""
    job_id = scope.get("path_params", {}).get("job_id")
    return {"job": str(job_id)[:80]} if job_id else {}


def _streams(scope: Scope, headers: Headers) -> bool:
    """Return whether the endpoint streams the body and limits its files itself."""
    multipart = headers.get("content-type", "").lower().startswith("multipart/form-data")
    method, path = scope["method"], own_path(scope)
    return (method in ("PUT", "PATCH") and path.startswith("/v1/captures/")) or (
        method == "POST" and path == "/v1/jobs" and multipart
    )
