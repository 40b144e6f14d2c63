"""The supervisor's question whether its API is ready stays one question, however long the API takes to start."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import suppress

import pytest

from splatmill_server.up.readiness import Readiness

NONE = (0, b"")


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as opened:
        opened.settimeout(0.2)
        yield opened


def questions(listener: socket.socket) -> list[socket.socket]:
    """Take what waits in the queue of the listening socket."""
    taken = []
    with suppress(TimeoutError):
        while True:
            taken.append(listener.accept()[0])
    return taken


def answer(question: socket.socket, status: str, body: bytes) -> None:
    assert question.recv(4096).startswith(b"GET /readyz HTTP/1.1\r\n")
    question.sendall(f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body)
    question.close()


def test_an_api_that_starts_slowly_finds_one_question(listener: socket.socket) -> None:
    readiness = Readiness(listener.getsockname())
    assert [readiness.ask(0.05) for _ in range(4)] == [NONE] * 4
    (question,) = questions(listener)
    answer(question, "200 OK", b"{}")
    assert readiness.ask() == (200, b"{}")
    assert questions(listener) == []


def test_it_is_asked_again_after_a_no_and_after_an_api_that_died(listener: socket.socket) -> None:
    readiness = Readiness(listener.getsockname())
    for said in ("503 Service Unavailable", None, "200 OK"):
        assert readiness.ask(0.05) == NONE
        (question,) = questions(listener)
        if said is None:
            question.close()
            assert readiness.ask() == NONE
        else:
            answer(question, said, b"why")
            assert readiness.ask() == (int(said[:3]), b"why")


def test_an_address_that_nothing_listens_on_is_no_answer(listener: socket.socket) -> None:
    readiness = Readiness(listener.getsockname())
    listener.close()
    assert readiness.ask() == NONE
