"""Keeps web pages of others from using a server through the browser of somebody who may.

A page can make a browser send requests to any address. Two checks stop it: the header Host, which a browser sets to the
name in the address, so that a name of the attacker that resolves to 127.0.0.1 (DNS rebinding) is refused; and the
header Origin, which a browser sets to the page's own address with each request that may change something. Programs
such as curl and the SDK send no Origin. A proxy may have put another name into Host; then Sec-Fetch-Site counts, by
which the browser compares the page with the address that it asked for. No script can set that header, and browsers send
it to https and to loopback addresses alone, under which no attacker's name leads to the server.
"""

from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import Scope

from splatmill_server.access.permission import SAFE_METHODS
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.settings import is_loopback

_PORTS = {"http": 80, "https": 443}


def check_host(scope: Scope, headers: Headers, host: str, allowed: Sequence[str]) -> None:
    """Raise a 421 problem if the header Host names neither this machine nor an address of the server.

    host: the address that the server was told to listen on.
    allowed: further names, as in SPLATMILL_ALLOWED_HOSTS.
    """
    named = headers.get("host", "")
    name = _name(named)
    listening = scope.get("server") or ("", None)
    local = name == "localhost" or name.endswith(".localhost") or is_loopback(name)
    if name and (local or name in (host.lower(), str(listening[0]).lower()) or _among(name, allowed)):
        return
    raise ProblemError(
        "host_not_allowed",
        f"The request is addressed to {named[:80]!r}, and this server without keys answers to names of its machine "
        "only.",
        advice="Use http://localhost or the address that the server listens on. If this is the name of a proxy before "
        "the server, add it to SPLATMILL_ALLOWED_HOSTS.",
    )


def check_origin(
    scope: Scope, headers: Headers, allowed: Sequence[str], origins: Sequence[str] = (), *, required: bool
) -> None:
    """Raise a 403 problem if a request that may change something comes from a page that is not the server's own.

    allowed: names of hosts whose pages may, as in SPLATMILL_ALLOWED_HOSTS.
    origins: origins whose pages may, as in SPLATMILL_CORS_ORIGINS.
    required: whether the request must say where it comes from, as that of a browser does.
    """
    if scope["method"] in SAFE_METHODS:
        return
    origin = headers.get("origin")
    if origin is None:
        site = headers.get("sec-fetch-site")
        if site in ("same-origin", "none") or (site is None and not required):
            return
    elif (
        headers.get("sec-fetch-site") == "same-origin"
        or _same(origin, headers.get("host", ""))
        or _among(_name(origin.partition("//")[2]), allowed)
        or origin in origins
    ):
        return
    raise ProblemError(
        "origin_not_allowed",
        f"The request comes from a web page at {(origin or 'an unknown address')[:80]!r}, which is not this server's.",
        advice="Open the page from this server's own address. If that is a proxy before the server, add the proxy's "
        "name to SPLATMILL_ALLOWED_HOSTS.",
    )


def _among(name: str, allowed: Sequence[str]) -> bool:
    """Return whether a name is one of `allowed`; `*.example.org` stands for all names that end so, `*` for all."""
    return any(
        pattern == "*" or name == pattern or (pattern.startswith("*.") and name.endswith(pattern[1:]))
        for pattern in allowed
    )


def _same(origin: str, host: str) -> bool:
    """Return whether the origin of a page is the address that a request is sent to."""
    try:
        page = urlsplit(origin)
        here = urlsplit(f"{page.scheme}://{host}")
        default = _PORTS[page.scheme]
        return bool(here.hostname) and (page.hostname, page.port or default) == (
            here.hostname,
            here.port or default,
        )
    except (ValueError, KeyError):
        return False


def _name(host: str) -> str:
    """Return the name in a header Host, in lower case and without port; "" for a text that is none."""
    try:
        parts = urlsplit(f"//{host}")
        if parts.netloc != host or parts.username is not None:
            return ""
        _ = parts.port  # raises ValueError for a text
        return (parts.hostname or "").removesuffix(".")
    except ValueError:
        return ""
