"""What one client does that could decide for others: each answer is that of somebody else, who does nothing wrong."""

from __future__ import annotations

import hashlib
import re
import socket
from contextlib import ExitStack

from splatmill.schema import SHA256_HEADER, JobState, StateEvent
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile
from tests.support.waiting import wait_for

AREA = "One client and the others"

_FAR = "9999999999999999999-0"


def _received(link: socket.socket, end: bytes) -> bytes:
    """What arrives until `end` has."""
    buffer = b""
    while end not in buffer and (chunk := link.recv(65536)):
        buffer += chunk
    return buffer


def _kind(answer: bytes) -> str:
    return answer.split(b" ", 2)[1].decode()


def _followed(bench: Bench, last: str) -> Answer:
    """The events that a second follower is sent, after a first one has sent this id."""
    job = bench.app.job()
    bench.app.begin(job)
    with ExitStack() as stack:
        links = []
        for header in (f"Last-Event-ID: {last}\r\n", ""):
            link = stack.enter_context(socket.create_connection(bench.app.address, 20))
            link.sendall(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: 127.0.0.1\r\n{header}\r\n".encode())
            links.append(link)
            wait_for(lambda: bench.app.service.feed.followers == len(links))  # called at once
        told = _received(links[1], b'"preparing"')
        bench.app.say(job, StateEvent(state=JobState.succeeded))
        told += _received(links[1], b'"succeeded"')
    wait_for(lambda: bench.app.service.feed.followers == 0)
    states = re.findall(rb'"state":"(\w+)"', told)
    return Answer(_kind(told), b", ".join(states).decode())


def _same_file(bench: Bench) -> Answer:
    """The answer to the first of two captures that receive the same file in pieces."""
    data = b"0123456789" * 100
    headers = {
        "Upload-Complete": "?0",
        "Upload-Length": str(len(data)),
        SHA256_HEADER: hashlib.sha256(data).hexdigest(),
    }
    with ExitStack() as stack:
        links = []
        for _ in range(2):
            address = f"/v1/captures/{bench.capture()}/images/video.mp4"
            begun = bench.app.http.put(address, headers=headers).headers["location"]
            link = stack.enter_context(socket.create_connection(bench.app.address, 20))
            link.sendall(
                f"PATCH {begun} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(data)}\r\nUpload-Offset: 0\r\n"
                "Upload-Complete: ?1\r\nContent-Type: application/partial-upload\r\n\r\n".encode()
                + data[:500]
            )
            links.append(link)
            wait_for(lambda: len(bench.app.service.partial_uploads._writers) == len(links))
        links[0].sendall(data[500:])
        answer = _received(links[0], b"}")
        links[1].sendall(data[500:])
        _received(links[1], b"}")
    return Answer(_kind(answer), answer.decode())


OTHERS = (
    Hostile(
        AREA,
        "the first follower of a job sends a `Last-Event-ID` that no stream reaches",
        lambda b: _followed(b, f"{_FAR}_{_FAR}_1" + f"_{_FAR}" * 3),
        "200",
        "queued, preparing, succeeded",
    ),
    Hostile(
        AREA,
        "another capture receives the same file in pieces at the same time",
        _same_file,
        "201",
        "video.mp4",
    ),
)
