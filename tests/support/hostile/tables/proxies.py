"""Hostile paths in the header by which a proxy names where it publishes the server, and web pages of other origins."""

from __future__ import annotations

from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile

AREA = "Proxies and web pages of others"


def _prefix(path: str) -> Hostile:
    return Hostile(
        AREA,
        f"`X-Forwarded-Prefix: {path}` for a page",
        lambda bench: bench.request("GET /", b"", f"X-Forwarded-Prefix: {path}"),
        "422 `invalid_request`",
        "X-Forwarded-Prefix",
    )


def _preflight(bench: Bench) -> Answer:
    asked = ("Origin: https://evil.example", "Access-Control-Request-Method: DELETE")
    return bench.request("OPTIONS /v1/jobs", b"", *asked)


PROXIES: tuple[Hostile, ...] = (
    *(_prefix(path) for path in ("//evil.example", '/"><script>', "/../v1", "/v1", "/a b")),
    Hostile(
        AREA, "A page of another origin asks whether it may delete", _preflight, "405 `method_not_allowed`"
    ),
)
