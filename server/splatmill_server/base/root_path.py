"""The path below which a proxy publishes the server, such as `/splats`. It stands before every address that an answer
names.

It is the setting `root_path`, or else what a trusted proxy says in `X-Forwarded-Prefix`. A proxy may pass it on with
each path, or strip it. As ASGI has it, `scope["path"]` then begins with `scope["root_path"]` either way.
"""

import re
from contextvars import ContextVar

from starlette.datastructures import URL, Headers
from starlette.types import Scope

HEADER = "X-Forwarded-Prefix"

OWN_PATHS = frozenset(
    {
        "compare",
        "docs",
        "glossary",
        "healthz",
        "jobs",
        "metrics",
        "models",
        "open",
        "openapi.json",
        "page",
        "readyz",
        "s",
        "sign-in",
        "v1",
        "vendor",
    }
)
"""First parts of the server's own paths. With one of them as root path, a path that a proxy has stripped could not be
told from one that it has not."""

_FORM = re.compile(r"(/(?!\.{1,2}(/|$))[A-Za-z0-9._~-]+)+", re.ASCII)

_root_path: ContextVar[str] = ContextVar("root_path", default="")


def checked(text: str) -> str:
    """Return a root path without the slash at its end; "" for none. Raises ValueError for a text that cannot be one."""
    path = text.strip().rstrip("/")
    if path and not _FORM.fullmatch(path):
        raise ValueError(
            f"{text[:80]!r} is not a path such as /splats: it begins with a slash, and between slashes has letters, "
            "digits, '.', '_', '~' and '-'"
        )
    if path.split("/")[1:2] and path.split("/")[1] in OWN_PATHS:
        raise ValueError(
            f"{text[:80]!r} begins like a path of the server's own; choose another, such as /splats"
        )
    return path


def use(root_path: str) -> None:
    """Put `root_path` before the addresses that are made from here on in this context: a request, or a task."""
    _root_path.set(root_path)


def locate(scope: Scope, headers: Headers, configured: str) -> None:
    """Find the root path of a request, and put it before its path where a proxy has stripped it.

    configured: the setting, which comes before the header.

    Raises ValueError if the header holds no path.
    """
    root_path = configured or checked(",".join(headers.getlist(HEADER)))
    use(root_path)
    if root_path:
        path = scope["path"]
        if path != root_path and not path.startswith(root_path + "/"):
            scope["path"] = root_path + path
        scope["root_path"] = root_path


def own_path(scope: Scope) -> str:
    """Return the path of a request below the root path."""
    return str(scope["path"]).removeprefix(scope.get("root_path", "")) or "/"


def location(scope: Scope, target: str) -> str:
    """Return what an answer's `Location` is to hold: a path with the root path before it.

    target: what the endpoint has put there. A redirection by Starlette names a host, which a proxy may have replaced.
    """
    here = URL(scope=scope)
    path = target.removeprefix(f"{here.scheme}://{here.netloc}")
    root_path = scope.get("root_path", "")
    return path if path.startswith((root_path + "/", "http:", "https:")) else root_path + path


def address(path: str) -> str:
    """Return the address by which clients reach a path of the server's own."""
    return _root_path.get() + path
