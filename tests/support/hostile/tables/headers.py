"""Hostile fields of headers, numbers, addresses and names: what Python's own parsers refuse, and control characters."""

from __future__ import annotations

import base64

from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.hostile.tables.requests import SCHEMA
from tests.support.hostile.tables.services import REFUSED

FIELDS = "Header fields"
DIGITS = "9" * 5000


def _origin(origin: str) -> Hostile:
    return Hostile(
        FIELDS,
        f"`Origin: {origin}`",
        lambda b: b.post("/v1/captures", {}, "Content-Type: application/json", f"Origin: {origin}"),
        "403 `origin_not_allowed`",
        "not this server",
    )


def _file(bench: Bench, *headers: str) -> Answer:
    """Download a file of a model with these fields."""
    job = bench.app.job()
    bench.app.begin(job)
    bench.app.finish(job)
    return bench.request(f"GET /v1/models/{job}/files/model.ply", b"", *headers)


def _whole_file(what: str, *headers: str) -> Hostile:
    return Hostile(FIELDS, what, lambda bench: _file(bench, *headers), "200")


def _page(moment: str) -> str:
    cursor = base64.urlsafe_b64encode(f"{moment}/{'0' * 16}".encode()).decode().rstrip("=")
    return f"GET /v1/jobs?cursor={cursor}"


def _methods(bench: Bench) -> Answer:
    """Made-up methods do not become labels of metrics."""
    for number in range(200):
        bench.request(f"{'X' * 2000}{number} /v1/jobs")
    text = bench.app.http.get("/metrics").text
    return Answer("200", f"{text.count('X' * 100)} made-up methods in {len(text) // 100_000} x 100 kB")


def _address(what: str, path: str, url: str) -> Hostile:
    return Hostile(
        "Addresses to fetch from or to call",
        f"{what} to `{url}`",
        lambda bench: bench.post(path.replace("{}", bench.capture()), {"url": url}),
        REFUSED,
        "is not an address",
    )


def _name(what: str, path: str, body: dict[str, object]) -> Hostile:
    return Hostile("Names for people", what, lambda b: b.post(path, body), SCHEMA, "control character")


HEADERS = (
    _origin("http://["),
    _origin("http://a:" + "9" * 30),
    _origin("http://[::1"),
    Hostile(
        FIELDS,
        "`Host: [`",
        lambda b: b.request("GET /v1/captures", b"", "Host: ["),
        "421 `host_not_allowed`",
    ),
    Hostile(
        FIELDS,
        "a port of 5,000 digits in `Host`",
        lambda b: b.request("GET /v1/captures", b"", f"Host: localhost:{DIGITS}"),
        "421 `host_not_allowed`",
    ),
    Hostile(
        FIELDS,
        "a length of 5,000 digits",
        lambda b: b.put("images/a.jpg", b"x", f"Content-Length: {DIGITS}"),
        "400",
    ),
    _whole_file("a `Range` of 5,000 digits: all of the file", f"Range: bytes={DIGITS}-{DIGITS}"),
    _whole_file("an `If-None-Match` of other bytes than ASCII", "If-None-Match: \xff\xe9"),
    _whole_file("an `If-Range` of other bytes than ASCII", "Range: bytes=0-1", "If-Range: \xff\xe9"),
    Hostile(
        FIELDS,
        "cookies of rubbish",
        lambda b: b.request("GET /v1/captures", b"", 'Cookie: =;"\\777;splatmill_session="\\'),
        "200",
    ),
    Hostile(
        FIELDS,
        "forwarding fields of rubbish",
        lambda b: b.request(
            "GET /v1/captures", b"", "X-Forwarded-For: [::1, \xff", "X-Forwarded-Proto: a:b", "Forwarded: ;="
        ),
        "200",
    ),
    Hostile(
        FIELDS,
        "a file name in a character set that does not exist",
        lambda b: b.form(("name=\"images\"; filename*=utf-9''%ff", b"x")),
        SCHEMA,
        "unknown field",
    ),
    Hostile(
        "API",
        "a page after a time of 100 digits",
        lambda b: b.request(_page("9" * 100)),
        "422 `cursor_invalid`",
    ),
    Hostile(
        "API",
        "a page after a time of no decimal digits",
        lambda b: b.request(_page("1_0")),
        "422 `cursor_invalid`",
    ),
    Hostile(
        "API",
        "a memory limit of 400 digits",
        lambda b: b.post("/v1/jobs", {"capture": b.capture(), "options": {"max_memory": "9" * 400 + "GB"}}),
        SCHEMA,
        "not a size",
    ),
    Hostile(
        "API",
        "a time limit of 400 digits",
        lambda b: b.post("/v1/jobs", {"capture": b.capture(), "options": {"time_budget": "9" * 400 + "h"}}),
        "422 `option_out_of_range`",
        "finite",
    ),
    Hostile(
        "API",
        "methods of 2,000 characters: none is kept in the metrics",
        _methods,
        "200",
        "0 made-up methods in 0 x 100 kB",
    ),
    *(
        _address(what, path, url)
        for what, path in (("an import", "/v1/captures/{}/import"), ("a webhook", "/v1/webhooks"))
        for url in ("http://xn--/", "http://xn--a.com/", "http://[v1.x]/", "http://a:99999999999999/")
    ),
    _name("an escape sequence of eight bits in the name of a key", "/v1/keys", {"name": "\x9b2J"}),
    _name(
        "a tabulator in the name of an edited model",
        f"/v1/models/{'0' * 16}/edits",
        {"min_opacity": 0.5, "name": "a\tb"},
    ),
    _name("a new line in the name of a link", f"/v1/models/{'0' * 16}/shares", {"name": "a\nb"}),
    Hostile(
        "Names for people",
        "an escape sequence in the name of a photo to hold out",
        lambda b: b.post("/v1/jobs", {"capture": b.capture(), "options": {"test_views": ["\x1b[2J"]}}),
        SCHEMA,
        "control character",
    ),
)
