"""Converts every error into a problem document (RFC 9457) with a code from `splatmill.schema.PROBLEMS`."""

import re
from collections.abc import Callable, Mapping
from typing import Any

import redis
import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.routing import Match
from starlette.types import Scope

from splatmill.backplane.storage.storage import StorageError, StorageFullError
from splatmill.schema import PROBLEM_MEDIA_TYPE, PROBLEMS, Problem, UnsafeName, code_for_status
from splatmill_server.base.root_path import own_path
from splatmill_server.base.validation import problem_of_validation

log = structlog.get_logger()

_SHARED = re.compile(r"^/s/[^/]+")


class ProblemError(HTTPException):
    """An error that becomes a problem document.

    It is an HTTPException because FastAPI passes on no other exceptions that are raised while it reads a body.
    """

    def __init__(
        self,
        code: str,
        detail: str,
        *,
        advice: str | None = None,
        facts: Mapping[str, Any] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(PROBLEMS[code].status, detail, headers)
        self.problem = Problem.of(code, detail, facts=dict(facts or {}), advice=advice)

    def about_file(self, name: str) -> "ProblemError":
        """Return the same error with the name of the file that it concerns, in the detail and among the facts."""
        problem = self.problem
        detail = problem.detail if name in problem.detail else f"{name}: {problem.detail}"
        facts = problem.facts | {"file": name}
        return ProblemError(problem.code, detail, advice=problem.advice, facts=facts, headers=self.headers)


class ProblemResponse(Response):
    """A response with a problem document. `instance` is the path of the request."""

    media_type = PROBLEM_MEDIA_TYPE

    def __init__(self, problem: Problem, instance: str, headers: Mapping[str, str] | None = None) -> None:
        named = problem.model_copy(update={"instance": problem.instance or instance})
        super().__init__(named.model_dump_json(exclude_none=True), problem.status, headers)


METHODS = ("DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT")
"""The methods of all endpoints."""


def _methods(request: Request) -> list[str]:
    """Return the methods that the address of a request accepts. Starlette names those of its first route alone."""

    def accepted(method: str) -> bool:
        asked = {**request.scope, "method": method}
        return any(route.matches(asked)[0] is Match.FULL for route in request.app.routes)

    return [method for method in METHODS if accepted(method)]


def for_people(scope: Scope, headers: Headers) -> bool:
    """Whether a browser asks for a page, to show it to a person, and not a program for an answer of the API."""
    return (
        scope["method"] in ("GET", "HEAD")
        and "text/html" in headers.get("accept", "")
        and not own_path(scope).startswith("/v1/")
    )


def install(app: FastAPI, missing_page: Callable[[Request], Response]) -> None:
    """Register the handlers of all errors that endpoints raise.

    missing_page: returns what people see at an address that has no page.
    """

    @app.exception_handler(HTTPException)
    def on_http(request: Request, error: HTTPException) -> Response:
        if isinstance(error, ProblemError):
            return ProblemResponse(error.problem, request.url.path, error.headers)
        if error.status_code == 404 and for_people(request.scope, request.headers):
            return missing_page(request)
        code, path, headers = code_for_status(error.status_code), request.url.path, dict(error.headers or {})
        match error.status_code:
            case 404:
                detail = f"There is nothing at {path}."
                advice = "Find the addresses at /docs or in /openapi.json."
            case 405:
                allowed = ", ".join(_methods(request))
                detail = f"{path} does not accept the method {request.method}."
                advice = f"Use {allowed}."
                headers["Allow"] = allowed
            case 400:
                detail = "The body does not have the format that its Content-Type names."
                advice = "Send valid JSON in UTF-8."
            case _:
                detail, advice = str(error.detail), ""
        problem = Problem.of(code, detail, advice=advice or None).model_copy(
            update={"status": error.status_code}
        )
        return ProblemResponse(problem, path, headers)

    @app.exception_handler(RequestValidationError)
    def on_validation(request: Request, error: RequestValidationError) -> Response:
        return ProblemResponse(problem_of_validation(error.errors()), request.url.path)

    @app.exception_handler(UnsafeName)
    def on_name(request: Request, error: UnsafeName) -> Response:
        return ProblemResponse(Problem.of("name_invalid", str(error)), request.url.path)

    @app.exception_handler(redis.RedisError)
    def on_redis(request: Request, error: redis.RedisError) -> Response:
        log.warning("queue unavailable", error=str(error), path=shown_path(request.scope))
        problem = problem_of_redis(error, admin=request.state.caller.admin)
        return ProblemResponse(problem, request.url.path, {"Retry-After": "5"})

    @app.exception_handler(StorageError)
    def on_storage(request: Request, error: StorageError) -> Response:
        log.warning("storage error", error=str(error), path=shown_path(request.scope))
        problem = problem_of_storage(error, admin=request.state.caller.admin)
        return ProblemResponse(problem, request.url.path)

    @app.exception_handler(ClientDisconnect)
    def on_disconnect(request: Request, _: ClientDisconnect) -> Response:
        # The client is gone, but a proxy in between may read this response.
        return ProblemResponse(body_cut_off(), request.url.path)


def shown_path(scope: Scope) -> str:
    """Return the path of a request as logs may show it: without the token of a shared link."""
    return _SHARED.sub("/s/...", own_path(scope))


LOGGED = "the log of the server has the reason"
"""What those read who may not read the reason: it may name hosts, folders and users."""


def problem_of_redis(error: redis.RedisError, *, admin: bool) -> Problem:
    """Return the problem for an error of Redis, which the caller logs: it cannot be reached, or refuses the command.

    admin: whether it is for an admin, who may read Redis' own words, which may name hosts and users.
    """
    cause = " ".join(str(error).split())[:300].removesuffix(".") or type(error).__name__
    cause = cause if admin else LOGGED
    if isinstance(error, redis.ResponseError):
        return Problem.of(
            "queue_unavailable",
            f"The job queue (Redis) refuses the request: {cause}. Stored files are not affected.",
            advice="Try again when the cause is removed, such as a full disk or memory of Redis.",
        )
    return Problem.of(
        "queue_unavailable",
        f"The job queue (Redis) cannot be reached: {cause}. Stored files are not affected.",
        advice="Try again in a few seconds. If the problem persists, check that Redis runs, and check REDIS_URL.",
    )


def problem_of_storage(error: StorageError, *, admin: bool = False) -> Problem:
    """Return the problem for an error of storage, which the caller logs: full, not writable, or not available.

    admin: whether it is for an admin, who may read the message, which may name folders, hosts and buckets.
    """
    text = str(error)
    detail = text if admin else storage_trouble(error)
    if isinstance(error, StorageFullError):
        advice = "Delete captures or jobs that are no longer needed, or extend the storage."
        return Problem.of("storage_full", detail, advice=advice)
    if "Permission denied" in text or "os error 13" in text or "os error 30" in text:
        advice = "Give the user that the server runs as write access to the storage folder."
        return Problem.of("storage_unwritable", detail, advice=advice)
    return Problem.of("storage_unavailable", detail, advice="Check SPLATMILL_STORAGE and try again.")


def storage_trouble(error: StorageError) -> str:
    """Return what anybody may read of an error of storage, which is logged."""
    return f"{error.summary.removesuffix('.')}; {LOGGED}."


def body_cut_off(received: int | None = None, announced: int | None = None) -> Problem:
    """Return the problem for a connection that ended before the body did."""
    facts = {} if received is None else {"received": received, "announced": announced}
    detail = "The body ended before its announced length; nothing was stored."
    return Problem.of("body_cut_off", detail, advice="Send the request again.", facts=facts)
