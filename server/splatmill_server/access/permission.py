"""What a caller may request. Requests that change something need the scope `train`, if the endpoint names no other."""

import re
from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import Depends, Request

from splatmill.schema import Scope
from splatmill_server.access.caller import Caller, Who
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import own_path

_OPEN = re.compile(
    r"/|/(healthz|readyz|openapi\.json|docs)|/(jobs|models)(/[^/]*)?|/sign-in|/glossary|/open|/(page|vendor|s)/.*",
    re.ASCII,
)

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})

F = TypeVar("F", bound=Callable[..., Any])


def is_open(path: str) -> bool:
    """Return whether a path needs no API key: those for probes, the files of the web page, and shared
    links, whose endpoints ask for the token in the path instead. The others hold no data.
    """
    return _OPEN.fullmatch(path) is not None


def needs(scope: Scope) -> Callable[[F], F]:
    """Decorate an endpoint with the scope that it needs, in place of the one that follows from its method."""

    def mark(endpoint: F) -> F:
        endpoint.needed_scope = scope  # type: ignore[attr-defined]  # functions take any attribute
        return endpoint

    return mark


def check_scope(who: Caller, needed: Scope) -> None:
    """Raise a 403 problem that names the scope if the caller does not have it."""
    if not who.has(needed):
        held = sorted(scope.value for scope in who.scopes)
        raise ProblemError(
            "forbidden",
            f"The request needs the scope {needed.value!r}, and the API key {who.key_name!r} has "
            f"{', '.join(held) or 'none'}.",
            advice="Use a key with this scope; an admin makes one with POST /v1/keys.",
            facts={"needed": needed.value, "scopes": held},
        )


async def _permitted(request: Request, who: Who) -> None:  # as a coroutine, it takes no thread of the pool
    if is_open(own_path(request.scope)):
        return
    endpoint = getattr(request.scope.get("route"), "endpoint", None)
    by_method = Scope.read if request.method in SAFE_METHODS else Scope.train
    check_scope(who, getattr(endpoint, "needed_scope", by_method))


PERMITTED: Any = Depends(_permitted)
"""The dependency of all routers that refuses a caller without the needed scope with a 403 problem."""
