"""Hostile uploads in pieces, and addresses that the server is asked to open."""

from __future__ import annotations

from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile

REFUSED = "422 `url_refused`"


def _append(bench: Bench, body: bytes, offset: str, complete: str = "?0") -> Answer:
    """Append to an upload of 10 bytes that has none yet."""
    address = f"/v1/captures/{bench.capture()}/images/video.mp4"
    begun = bench.app.http.put(address, content=b"", headers={"Upload-Complete": "?0", "Upload-Length": "10"})
    headers = (f"Upload-Offset: {offset}", f"Upload-Complete: {complete}")
    line = f"PATCH {begun.headers['location']}"
    return bench.request(line, body, *headers, "Content-Type: application/partial-upload")


def _begin(bench: Bench, name: str) -> Answer:
    line = f"PUT /v1/captures/{bench.capture()}/images/{name}"
    return bench.request(line, b"", "Upload-Complete: ?0", "Upload-Length: 10")


def _import(what: str, url: str, said: str, kind: str = REFUSED) -> Hostile:
    return Hostile(
        "Addresses to fetch from or to call",
        what,
        lambda bench: bench.post(f"/v1/captures/{bench.capture()}/import", {"url": url, "role": "images"}),
        kind,
        said,
    )


def _webhook(what: str, url: str, said: str) -> Hostile:
    return Hostile(
        "Addresses to fetch from or to call",
        what,
        lambda bench: bench.post("/v1/webhooks", {"url": url}),
        REFUSED,
        said,
    )


SERVICES = (
    Hostile(
        "Uploads in pieces",
        "a gap",
        lambda b: _append(b, b"abc", "5"),
        "409 `upload_offset_differs`",
        "holds 0",
    ),
    Hostile(
        "Uploads in pieces",
        "more than was announced",
        lambda b: _append(b, b"a" * 20, "0"),
        "400 `upload_length_differs`",
    ),
    Hostile(
        "Uploads in pieces",
        "less than was announced",
        lambda b: _append(b, b"abc", "0", "?1"),
        "400 `upload_length_differs`",
    ),
    Hostile(
        "Uploads in pieces",
        "an offset of -5",
        lambda b: _append(b, b"abc", "-5"),
        "422 `invalid_request`",
        "Upload-Offset",
    ),
    Hostile(
        "Uploads in pieces",
        "an offset of 5,000 digits",
        lambda b: _append(b, b"abc", "9" * 5000),
        "422 `invalid_request`",
    ),
    Hostile(
        "Uploads in pieces",
        "`../escape.jpg`",
        lambda b: _begin(b, "..%2Fescape.jpg"),
        "422 `name_invalid`",
        "'..'",
    ),
    _import("this machine", "http://127.0.0.1/a.jpg", "this machine"),
    _import("this machine as a number", "http://2130706433/a.jpg", "this machine"),
    _import("this machine in IPv6", "http://[::ffff:127.0.0.1]/a.jpg", "IPv4-mapped"),
    _import("the metadata of a cloud", "http://169.254.169.254/latest/meta-data", "link-local"),
    _import("a private network", "http://10.0.0.1/a.jpg", "private"),
    _import("a file", "file:///etc/passwd", "not the address of a web server"),
    _import("Redis", "http://localhost:6379/", "port 6379"),
    _import("a name and a password", "http://user:password@example.org/a.jpg", "password"),
    _import("a header in the address", "http://127.0.0.1/\r\nX: y", "control characters"),
    _webhook("a webhook to this machine", "http://127.0.0.1/hook", "this machine"),
    _webhook("a webhook to a private network", "https://192.168.0.1/hook", "private"),
)
