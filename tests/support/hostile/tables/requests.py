"""Hostile requests: names, bodies, forms, and misuse of the API and of its event streams."""

from __future__ import annotations

import socket
from contextlib import ExitStack

from splatmill.backplane.storage import layout
from splatmill.schema import Role
from tests.support.hostile.bench import MAX_FILES, Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.served_app import stored
from tests.support.waiting import wait_for

INVALID_NAME = "422 `name_invalid`"
NO_JSON = "400 `malformed_body`"
SCHEMA = "422 `invalid_request`"
OPTION = "422 `option_out_of_range`"


def _two_spellings(bench: Bench) -> Answer:
    """The same name composed and decomposed: one file, so other bytes are refused."""
    capture = bench.capture()
    assert bench.put("images/%C3%A9.jpg", b"one", capture=capture).kind == "201"
    return bench.put("images/e%CC%81.jpg", b"two", capture=capture)


def _case(bench: Bench) -> Answer:
    capture = bench.capture()
    assert bench.put("images/x.jpg", b"one", capture=capture).kind == "201"
    return bench.put("images/X.jpg", b"two", capture=capture)


def _file_and_folder(bench: Bench) -> Answer:
    capture = bench.capture()
    assert bench.put("images/x", b"one", capture=capture).kind == "201"
    return bench.put("images/x/a.jpg", b"two", capture=capture)


def _folder_and_file(bench: Bench) -> Answer:
    capture = bench.capture()
    assert bench.put("images/x/a.jpg", b"one", capture=capture).kind == "201"
    return bench.put("images/x", b"two", capture=capture)


def _cut_off(bench: Bench) -> Answer:
    """A body that ends early leaves nothing behind."""
    capture = bench.capture()
    before = stored(bench.app)
    line = f"PUT /v1/captures/{capture}/images/cut.jpg"
    answer = bench.request(line, b"x" * 10, length=100, cut=True)
    assert not bench.app.service.storage.exists(layout.capture_file(capture, Role.images, "cut.jpg"))
    # The client is gone before the server has put away what came.
    wait_for(lambda: all(path in before for path in stored(bench.app)))
    return answer


def _announced(bench: Bench) -> Answer:
    return bench.request(f"PUT /v1/captures/{bench.capture()}/images/a.jpg", b"x", length=5 << 30)


def _job(bench: Bench, options: bytes) -> Answer:
    return bench.post("/v1/jobs", b'{"capture": "%s", "options": %s}' % (bench.capture().encode(), options))


def _form_type(bench: Bench, content_type: str, body: bytes = b"x") -> Answer:
    return bench.request("POST /v1/jobs", body, f"Content-Type: {content_type}")


def _many_files(bench: Bench) -> Answer:
    before = stored(bench.app)
    answer = bench.form(*((f'name="images"; filename="{k}.jpg"', b"%d" % k) for k in range(MAX_FILES + 10)))
    assert stored(bench.app) == before
    return answer


def _other_body(bench: Bench) -> Answer:
    capture, header = bench.capture(), ("Content-Type: application/json", "Idempotency-Key: once")
    bench.post("/v1/jobs", {"capture": capture}, *header)
    return bench.post("/v1/jobs", {"capture": capture, "name": "another"}, *header)


def _long_key(bench: Bench) -> Answer:
    header = ("Content-Type: application/json", f"Idempotency-Key: {'k' * 10_000}")
    return bench.post("/v1/jobs", {"capture": bench.capture()}, *header)


def _range(bench: Bench, ranges: str) -> Answer:
    return bench.request(f"GET /v1/models/{_model(bench)}/files/model.ply", b"", f"Range: {ranges}")


def _model(bench: Bench) -> str:
    job = bench.app.job()
    bench.app.begin(job)
    bench.app.finish(job)
    return job


def _events(bench: Bench, last: str) -> Answer:
    return bench.request(f"GET /v1/jobs/{_model(bench)}/events", b"", f"Last-Event-ID: {last}")


def _slow(bench: Bench) -> Answer:
    """Another client is answered while a hundred never finish their headers."""
    with ExitStack() as stack:
        for _ in range(100):
            link = stack.enter_context(socket.create_connection(bench.app.address, 10))
            link.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ")
        return bench.request("GET /healthz")


def _render(bench: Bench, camera: bytes) -> Answer:
    return bench.post(f"/v1/models/{_model(bench)}/render", b'{"camera": %s}' % camera)


_CAMERA = (
    b'{"width": %s, "height": 48, "fov_y_deg": 60, '
    b'"camera_to_world": [[%s, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'
)

REQUESTS = (
    Hostile("Names", "`../escape.jpg`", lambda b: b.put("images/..%2Fescape.jpg"), INVALID_NAME, "'..'"),
    Hostile("Names", "`/etc/passwd`", lambda b: b.put("images/%2Fetc%2Fpasswd"), INVALID_NAME, "absolute"),
    Hostile("Names", "`C:\\x.jpg`", lambda b: b.put("images/C:%5Cx.jpg"), INVALID_NAME, "backslash"),
    Hostile("Names", "a NUL byte", lambda b: b.put("images/a%00.jpg"), INVALID_NAME, "control character"),
    Hostile("Names", "bytes that are not UTF-8", lambda b: b.put("images/%FF%FE.jpg"), INVALID_NAME, "UTF-8"),
    Hostile(
        "Names", "a part of 300 bytes", lambda b: b.put(f"images/{'a' * 300}.jpg"), INVALID_NAME, "200 bytes"
    ),
    Hostile(
        "Names", "a path of 100,000 bytes", lambda b: b.put(f"images/{'a' * 100_000}"), INVALID_NAME, "512"
    ),
    Hostile(
        "Names", "20 folders in each other", lambda b: b.put(f"images/{'a/' * 20}x"), INVALID_NAME, "parts"
    ),
    Hostile("Names", "`x#1`, which storage uses", lambda b: b.put("images/x%231"), INVALID_NAME, "reserved"),
    Hostile("Names", "`CON.jpg`, reserved by Windows", lambda b: b.put("images/CON.jpg"), "201", "'CON.jpg'"),
    Hostile(
        "Names",
        "`é` composed, then decomposed with other bytes",
        _two_spellings,
        "409 `name_taken`",
        "other bytes",
    ),
    Hostile("Names", "`x.jpg`, then `X.jpg` with other bytes", _case, "201", "'X.jpg'"),
    Hostile("Names", "`x`, then `x/a.jpg`", _file_and_folder, "409 `name_taken`", "images/x"),
    Hostile("Names", "`x/a.jpg`, then `x`", _folder_and_file, "409 `name_taken`", "images/x/a.jpg"),
    Hostile("Names", "a role of its own, `secrets/a.jpg`", lambda b: b.put("secrets/a.jpg"), SCHEMA, "role"),
    Hostile(
        "Names",
        "an id that leads elsewhere",
        lambda b: b.request("GET /v1/jobs/..%2F..%2Fetc"),
        "404 `not_found`",
    ),
    Hostile(
        "Names",
        "a file of a model that leads elsewhere",
        lambda b: b.request(f"GET /v1/models/{_model(b)}/files/..%2Fjob.json"),
        "404 `file_not_found`",
    ),
    Hostile("Bodies", "cut off; nothing is stored", _cut_off, "no answer"),
    Hostile(
        "Bodies",
        "another digest than announced",
        lambda b: b.put("images/a.jpg", b"x", f"X-Content-SHA256: {'0' * 64}"),
        "422 `digest_mismatch`",
        "images/a.jpg",
    ),
    Hostile("Bodies", "no bytes", lambda b: b.put("images/a.jpg", b""), "422 `file_empty`", "images/a.jpg"),
    Hostile("Bodies", "5 GiB announced", _announced, "413 `body_too_large`", "images/a.jpg"),
    Hostile(
        "Bodies", "a negative length", lambda b: b.put("images/a.jpg", b"x", "Content-Length: -5"), "400"
    ),
    Hostile(
        "Bodies",
        "two lengths",
        lambda b: b.put("images/a.jpg", b"x", "Content-Length: 1", "Content-Length: 7"),
        "400",
    ),
    Hostile(
        "Bodies",
        "a length and chunks, to smuggle a request",
        lambda b: b.put(
            "images/a.jpg",
            b"0\r\n\r\nGET / HTTP/1.1\r\n\r\n",
            "Content-Length: 1",
            "Transfer-Encoding: chunked",
        ),
        "400 `body_cut_off`",
    ),
    Hostile(
        "Bodies",
        "chunks of no length",
        lambda b: b.put("images/a.jpg", b"zz\r\nabc", "Transfer-Encoding: chunked"),
        "400",
    ),
    Hostile(
        "Bodies",
        "a web page as a photo, by its content type",
        lambda b: b.put("images/a.jpg", b"<script>", "Content-Type: text/html"),
        "415 `unsupported_media_type`",
        "images/a.jpg",
    ),
    Hostile("JSON", "100,000 brackets", lambda b: b.post("/v1/captures", b"[" * 100_000), NO_JSON),
    Hostile(
        "JSON", "2 MB", lambda b: b.post("/v1/captures", {"name": "a" * 2_000_000}), "413 `body_too_large`"
    ),
    Hostile(
        "JSON", "bytes that are not UTF-8", lambda b: b.post("/v1/captures", b'{"name": "\xff"}'), NO_JSON
    ),
    Hostile(
        "JSON",
        "half of a surrogate pair",
        lambda b: b.post("/v1/captures", rb'{"name": "\ud800"}'),
        SCHEMA,
        "unicode",
    ),
    Hostile(
        "JSON",
        "control characters for terminals",
        lambda b: b.post("/v1/captures", {"name": "\x1b[2J"}),
        SCHEMA,
        "control character",
    ),
    Hostile("JSON", "a list for an object", lambda b: b.post("/v1/captures", [1]), SCHEMA, "dictionary"),
    Hostile("JSON", "an unknown field", lambda b: b.post("/v1/captures", {"admin": True}), SCHEMA, "admin"),
    Hostile(
        "JSON",
        "a key twice: the last one counts",
        lambda b: b.post("/v1/captures", b'{"name": "a", "name": "b"}'),
        "201",
        "'b'",
    ),
    Hostile("JSON", "NaN", lambda b: _job(b, b'{"time_budget": NaN}'), OPTION, "finite"),
    Hostile("JSON", "1e999", lambda b: _job(b, b'{"time_budget": 1e999}'), OPTION, "finite"),
    Hostile(
        "JSON",
        "an integer of 5,000 digits",
        lambda b: _job(b, b'{"steps": 1%s}' % (b"0" * 5000)),
        NO_JSON,
        "out of range",
    ),
    Hostile(
        "JSON",
        "form data in its place",
        lambda b: b.post("/v1/captures", b"a=b", "Content-Type: application/x-www-form-urlencoded"),
        "415 `unsupported_media_type`",
    ),
    Hostile("Forms", "no boundary", lambda b: _form_type(b, "multipart/form-data"), NO_JSON, "boundary"),
    Hostile(
        "Forms",
        "a boundary of 5,000 bytes",
        lambda b: _form_type(b, f"multipart/form-data; boundary={'B' * 5000}"),
        NO_JSON,
        "boundary",
    ),
    Hostile(
        "Forms",
        "no form at all",
        lambda b: _form_type(b, "multipart/form-data; boundary=B", b"x" * 100),
        NO_JSON,
        "malformed",
    ),
    Hostile(
        "Forms",
        "more files than a capture may hold",
        _many_files,
        "413 `body_too_large`",
        "no more are accepted",
    ),
    Hostile(
        "Forms",
        "the same field 20,000 times",
        lambda b: b.form(*[('name="options"', b"{}")] * 20_000),
        SCHEMA,
        "twice",
    ),
    Hostile(
        "Forms",
        "a field of 2 MB",
        lambda b: b.form(('name="options"', b" " * 2_000_000)),
        "413 `body_too_large`",
        "'options'",
    ),
    Hostile(
        "Forms",
        "a part with a header of 2 MB",
        lambda b: b.form((f'name="options"; x="{"a" * 2_000_000}"', b"{}")),
        NO_JSON,
        "header size",
    ),
    Hostile(
        "Forms",
        "a part with 10,000 headers",
        lambda b: b.form(('name="options"' + "\r\nX: a" * 10_000, b"{}")),
        NO_JSON,
        "header count",
    ),
    Hostile(
        "Forms",
        "a file called `../../x`",
        lambda b: b.form(('name="images"; filename="../../x"', b"x")),
        INVALID_NAME,
        "'..'",
    ),
    Hostile(
        "Forms",
        "options nested 1,000 deep",
        lambda b: b.form(
            *[(f'name="images"; filename="{k}"', b"%d" % k) for k in range(2)],
            ('name="options"', b'{"preset":' * 1000 + b"1" + b"}" * 1000),
        ),
        NO_JSON,
    ),
    Hostile(
        "Forms",
        "no end",
        lambda b: b.form(('name="images"; filename="x"', b"x"), end=b""),
        "400 `body_cut_off`",
    ),
    Hostile(
        "API", "an idempotency key again, for another request", _other_body, "409 `idempotency_conflict`"
    ),
    Hostile("API", "an idempotency key of 10,000 bytes", _long_key, SCHEMA, "Idempotency-Key"),
    Hostile(
        "API",
        "a thousand ranges: all of the file, once",
        lambda b: _range(b, "bytes=" + ",".join(["0-0"] * 1000)),
        "200",
    ),
    Hostile(
        "API", "a range behind the end", lambda b: _range(b, "bytes=99999999-"), "416 `range_not_satisfiable`"
    ),
    Hostile("API", "a range of no unit: all of the file", lambda b: _range(b, "\xff=\xff"), "200"),
    Hostile("API", "a page of -1", lambda b: b.request("GET /v1/jobs?limit=-1"), SCHEMA, "limit"),
    Hostile(
        "API",
        "a cursor of another service",
        lambda b: b.request("GET /v1/jobs?cursor=AAAA"),
        "422 `cursor_invalid`",
    ),
    Hostile(
        "API",
        "a method that does not exist",
        lambda b: b.request("HACK /v1/jobs"),
        "405 `method_not_allowed`",
    ),
    Hostile(
        "API",
        "a thousand headers of a kilobyte",
        lambda b: b.request("GET /healthz", b"", *(f"X-{k}: {'a' * 1000}" for k in range(1000))),
        "400",
    ),
    Hostile(
        "API",
        "TLS on the plain port",
        lambda b: b.send(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" * 20),
        "400",
    ),
    Hostile("API", "no Host", lambda b: b.send(b"GET /healthz HTTP/1.1\r\nConnection: close\r\n\r\n"), "400"),
    Hostile(
        "API",
        "a name in Host that is not this machine's",
        lambda b: b.request("GET /v1/captures", b"", "Host: evil.example"),
        "421 `host_not_allowed`",
    ),
    Hostile(
        "API",
        "rubbish in Host",
        lambda b: b.request("GET /v1/captures", b"", "Host: a b/\\@:::"),
        "421 `host_not_allowed`",
    ),
    Hostile(
        "API",
        "a web page of another site that starts a training",
        lambda b: b.post(
            "/v1/jobs", {"capture": "x"}, "Content-Type: application/json", "Origin: http://evil.example"
        ),
        "403 `origin_not_allowed`",
    ),
    Hostile("API", "a hundred clients that never finish their headers, and one that does", _slow, "200"),
    Hostile(
        "API",
        "a view of 10^9 pixels a side",
        lambda b: _render(b, _CAMERA % (b"1000000000", b"1")),
        "422 `size_out_of_range`",
    ),
    Hostile(
        "API", "a camera of NaN", lambda b: _render(b, _CAMERA % (b"64", b"NaN")), "422 `camera_invalid`"
    ),
    Hostile(
        "Events", "a `Last-Event-ID` of another service", lambda b: _events(b, "42"), "422 `cursor_invalid`"
    ),
    Hostile(
        "Events",
        "a `Last-Event-ID` behind all events: nothing follows",
        lambda b: _events(b, "9999999999999999999-0_9999999999999999999-0_9" + "_0-0" * 3),
        "204",
    ),
    Hostile(
        "Events", "a `Last-Event-ID` of 5,000 digits", lambda b: _events(b, f"{'9' * 5000}-0_0-0_0"), "422"
    ),
)
