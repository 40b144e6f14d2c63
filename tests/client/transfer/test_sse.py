"""Event streams: parsing is independent of how the bytes are cut, and a broken stream is taken up where it broke.

Does not prove that the server keeps its events; the server's tests do.
"""

import asyncio
import itertools
import json
from collections.abc import AsyncIterator
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatmill import Client
from splatmill.errors import ConnectionFailed, NotFound
from splatmill.schema import EventRecord, LogEvent, StateEvent
from splatmill.transfer.sse import Message, read_messages

SSE = {"Content-Type": "text/event-stream"}


def parse(chunks: list[bytes]) -> list[Message]:
    async def source() -> AsyncIterator[bytes]:
        for chunk in chunks:
            yield chunk

    async def collect() -> list[Message]:
        return [message async for message in read_messages(source())]

    return asyncio.run(collect())


@given(
    st.lists(
        st.text(st.characters(exclude_characters="\r\n", exclude_categories=["Cs"]), max_size=12), max_size=6
    ),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.lists(st.integers(0, 200), max_size=8),
)
def test_cutting_the_bytes_changes_nothing(texts: list[str], end: str, cuts: list[int]):
    stream = "".join(
        f": beat{end}id: {n}{end}data: {text}{end}{end}" for n, text in enumerate(texts)
    ).encode()
    # A lone CR at the very end may be half of a CRLF, so the last message shows once something follows.
    stream += f": end{end}".encode()
    places = sorted({min(cut, len(stream)) for cut in cuts} | {0, len(stream)})
    chunks = [stream[a:b] for a, b in itertools.pairwise(places)]
    assert parse(chunks) == [Message(str(n), text) for n, text in enumerate(texts)]


def test_fields_of_the_standard():
    stream = b"data: one\ndata:two\n\nevent: x\nretry: 5\n\nid: 7\ndata\n\ndata: \xe2\x80\xa8kept\n\ndata: unfinished\n"
    assert parse([stream]) == [Message(None, "one\ntwo"), Message("7", ""), Message("7", "\u2028kept")]


def message(number: int, event: StateEvent | LogEvent) -> bytes:
    record = EventRecord(id=f"{number}-0", attempt=1, at=datetime(2026, 1, 1, tzinfo=UTC), event=event)
    return f"id: {number}-0\ndata: {record.model_dump_json()}\n\n".encode()


def said(record: EventRecord) -> str:
    assert isinstance(record.event, LogEvent)
    return record.event.message


def job(state: str) -> bytes:
    entry = {"id": "j1", "capture": "c1", "state": state, "options": {}, "created_at": "2026-01-01T00:00:00Z"}
    return json.dumps(entry).encode()


def test_a_broken_stream_goes_on_after_the_last_event(peer, reply):
    parts = [message(n, LogEvent(message=f"line {n}")) for n in range(4)]
    streams = iter(
        [
            reply(body=parts[0] + parts[1] + parts[2], cut=len(parts[2]) + 3, headers=SSE),  # breaks inside 1
            reply(dropped=True),
            reply(status=503),
            reply(body=parts[1] + b"data: {}\n\n" + parts[2], headers=SSE),  # ends although the job runs
            reply(body=parts[3], headers=SSE),
        ]
    )
    states = iter(["training", "training", "succeeded"])
    peer.answer = lambda request: (
        next(streams) if request.path.endswith("/events") else reply(body=job(next(states)))
    )
    with Client(peer.url) as client:
        handle = client.job("j1")
        records = list(handle.events())
    assert [said(record) for record in records] == ["line 0", "line 1", "line 2", "line 3"]
    asked = [
        request.headers.get("last-event-id") for request in peer.requests if request.path.endswith("/events")
    ]
    assert asked == [None, "0-0", "0-0", "0-0", "2-0"]
    assert handle.job.state.final


def test_a_part_of_the_service_that_is_down_is_waited_for(peer, reply):
    asked: list[str] = []

    def answer(request):
        asked.append(request.path)
        if request.path.endswith("/events"):
            return reply(body=b": nothing to tell\n\n", headers=SSE)
        if 1 < len(asked) < 8:
            return reply(status=503)
        return reply(body=job("queued" if len(asked) < 20 else "cancelled"))

    peer.answer = answer
    with Client(peer.url, retries=0) as client:
        assert list(client.job("j1").events()) == []
    assert len(asked) >= 20


def test_a_job_that_is_gone_ends_the_following(peer, reply):
    peer.answer = lambda request: (
        reply(status=404) if request.path.endswith("/events") else reply(body=job("queued"))
    )
    with Client(peer.url) as client, pytest.raises(NotFound):
        list(client.job("j1").events())


def test_patience_has_an_end(peer, reply, monkeypatch):
    from splatmill.transfer.connection import Connection
    from splatmill.transfer.sse import follow_events

    peer.answer = lambda _: reply(dropped=True)

    async def run() -> None:
        connection = Connection(peer.url)
        try:
            async for _ in follow_events(connection, "/v1/jobs/j1/events", give_up=1.0):
                pass
        finally:
            await connection.close()

    with pytest.raises(ConnectionFailed, match="was lost"):
        asyncio.run(run())
    assert len(peer.requests) > 1


def test_leaving_the_loop_early_closes_the_stream(peer, reply):
    parts = b"".join(message(n, LogEvent(message=str(n))) for n in range(3))
    peer.answer = lambda request: (
        reply(body=parts + b" " * 10, cut=0, headers=SSE)
        if request.path.endswith("/events")
        else reply(body=job("training"))
    )
    with Client(peer.url) as client:
        handle = client.job("j1")
        for record in handle.events():
            assert said(record) == "0"
            break
        assert handle.refresh().state == "training"


def test_heartbeats_show_that_a_quiet_connection_lives():
    from splatmill.transfer.connection import Connection
    from splatmill.transfer.sse import follow_events

    connections = 0
    head = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n"

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        await reader.readuntil(b"\r\n\r\n")
        if connections == 1:
            writer.write(head.replace(b"\r\n\r\n", b"\r\nContent-Length: 100000\r\n\r\n"))
            for _ in range(20):  # two seconds in which nothing happens but heartbeats
                writer.write(b": still here\n\n")
                await writer.drain()
                await asyncio.sleep(0.1)
        elif connections == 3:
            writer.write(head + message(1, LogEvent(message="line 1")))
            await writer.drain()
        writer.close()

    async def run() -> list[str]:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        connection = Connection(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}")
        try:
            return [said(r) async for r in follow_events(connection, "/v1/jobs/j1/events", give_up=1.5)]
        finally:
            await connection.close()
            server.close()

    assert asyncio.run(run()) == ["line 1"]
    assert connections == 3


def test_an_id_that_no_header_can_hold_is_not_sent_back(peer, reply):
    parts = [message(n, LogEvent(message=f"line {n}")) for n in range(3)]
    parts[1] = parts[1].replace(b"id: 1-0", "id: é🦊".encode(), 1)
    streams = iter(
        [
            reply(body=b"".join(parts), cut=len(parts[2]), headers=SSE),
            reply(body=parts[2], headers=SSE),
        ]
    )
    states = iter(["training", "succeeded"])
    peer.answer = lambda request: (
        next(streams) if request.path.endswith("/events") else reply(body=job(next(states)))
    )
    with Client(peer.url) as client:
        records = list(client.job("j1").events())
    assert [said(record) for record in records] == ["line 0", "line 1", "line 2"]
    asked = [
        request.headers.get("last-event-id") for request in peer.requests if request.path.endswith("/events")
    ]
    assert asked == [None, "0-0"]
