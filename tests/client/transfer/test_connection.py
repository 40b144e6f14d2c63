"""What is tried again and what is not, how an answer becomes an error, and that a key never travels in an address.

Does not prove anything about TLS or proxies, which are httpx's.
"""

import json
from typing import Any

import httpx
import pytest

from splatmill import Client
from splatmill.errors import ConnectionFailed, NotFound, Refused, ServerError, TooManyRequests, Unavailable
from splatmill.schema import IDEMPOTENCY_HEADER, Problem
from splatmill.transfer.connection import own_path, retry_after

JOB = {
    "id": "j1",
    "capture": "c1",
    "state": "queued",
    "options": {},
    "created_at": "2026-01-01T00:00:00Z",
}
JOB_BYTES = json.dumps(JOB).encode()


def problem(code: str) -> dict[str, Any]:
    document = Problem.of(code, "It was so.", facts={"n": 1}, advice="Do that.")
    return {
        "status": document.status,
        "body": document.model_dump_json().encode(),
        "headers": {"Content-Type": "application/problem+json"},
    }


@pytest.mark.parametrize(
    "trouble", [{"dropped": True}, {"status": 503}, {"status": 429}, {"body": b"x" * 9, "cut": 5}]
)
def test_reading_is_tried_again(peer, reply, trouble):
    peer.script(reply(**trouble), reply(**trouble), reply(body=JOB_BYTES))
    with Client(peer.url) as client:
        assert client.job("j1").id == "j1"
    assert len(peer.requests) == 3


def test_plain_http_reads_no_certificates(peer, reply, monkeypatch):
    monkeypatch.setattr("certifi.where", lambda: "/nonexistent.pem")
    peer.script(reply(body=JOB_BYTES))
    with Client(peer.url) as client:
        assert client.job("j1").id == "j1"
    with pytest.raises(FileNotFoundError):
        Client("https://127.0.0.1:1")


def test_it_gives_up_with_the_last_reason(peer, reply):
    peer.answer = lambda _: reply(**problem("queue_unavailable"))
    with Client(peer.url, retries=2) as client, pytest.raises(Unavailable) as error:
        client.job("j1")
    assert error.value.code == "queue_unavailable"
    assert len(peer.requests) == 3


def test_a_request_that_was_not_handled_is_sent_again_when_the_server_says_so(peer, reply, tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"x")
    busy = problem("too_many_requests")
    busy["headers"] |= {"Retry-After": "0"}
    capture = json.dumps({"id": "c1", "created_at": JOB["created_at"]}).encode()
    file = json.dumps({"role": "images", "name": "a.jpg", "size": 1, "sha256": "0" * 64}).encode()
    peer.script(reply(**busy), reply(status=201, body=capture), reply(status=201, body=file))
    with Client(peer.url) as client:
        assert client.upload(tmp_path)[0].id == "c1"
    assert [request.method for request in peer.requests] == ["POST", "POST", "PUT"]


def test_a_limit_that_no_time_lifts_is_told_at_once(peer, reply):
    peer.answer = lambda _: reply(**problem("too_many_jobs"))
    with Client(peer.url) as client, pytest.raises(TooManyRequests) as error:
        client.submit("c1")
    assert error.value.retry_after is None
    assert len(peer.requests) == 1


def test_a_long_time_to_wait_is_told_and_not_slept_through(peer, reply):
    busy = problem("too_many_requests")
    busy["headers"] |= {"Retry-After": "3600"}
    peer.answer = lambda _: reply(**busy)
    with Client(peer.url) as client, pytest.raises(TooManyRequests) as error:
        client.job("j1")
    assert error.value.retry_after == 3600
    assert len(peer.requests) == 1


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        ("7", 7.0),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Wed, 21 Oct 2015 07:28:00", 0.0),
        ("soon", None),
        ("-3", None),
        ("", None),
    ],
)
def test_the_time_to_wait_is_a_number_or_a_date(header, seconds):
    assert retry_after(httpx.Response(429, headers={"Retry-After": header})) == seconds


def test_creating_a_capture_is_sent_once(peer, reply, tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"x")
    peer.answer = lambda _: reply(dropped=True)
    with Client(peer.url) as client, pytest.raises(ConnectionFailed, match="was lost"):
        client.upload(tmp_path)
    assert len(peer.requests) == 1


def test_creating_a_job_is_repeated_under_one_key(peer, reply):
    peer.script(reply(dropped=True), reply(status=503), reply(status=202, body=JOB_BYTES))
    with Client(peer.url) as client:
        client.submit("c1")
        keys = {request.headers[IDEMPOTENCY_HEADER.lower()] for request in peer.requests}
        peer.script(reply(status=202, body=JOB_BYTES))
        client.submit("c1")
    assert len(peer.requests) == 4
    assert len(keys) == 1
    assert peer.requests[-1].headers[IDEMPOTENCY_HEADER.lower()] not in keys, "another job needs another key"


@pytest.mark.parametrize("status", [400, 404, 409, 422, 500, 507])
def test_a_refusal_that_waiting_does_not_mend_is_final(peer, reply, status):
    peer.answer = lambda _: reply(status=status)
    with (
        Client(peer.url) as client,
        pytest.raises(Refused) as error,
    ):
        client.job("j1")
    assert error.value.problem.status == status
    assert len(peer.requests) == 1


def test_a_problem_arrives_whole(peer, reply):
    peer.script(reply(**problem("job_not_found")))
    with Client(peer.url) as client, pytest.raises(NotFound) as error:
        client.job("j1")
    assert error.value.code == "job_not_found"
    assert error.value.problem.facts == {"n": 1}
    assert str(error.value) == "It was so. Do that."


@pytest.mark.parametrize("body", [b"<html>bad gateway</html>", b'{"not": "a problem"}'])
def test_a_page_of_something_else_is_told_as_such(peer, reply, body):
    peer.answer = lambda _: reply(status=502, body=body, headers={"Content-Type": "application/problem+json"})
    with Client(peer.url, retries=0) as client, pytest.raises(ServerError, match="502 Scripted") as error:
        client.job("j1")
    assert error.value.problem.facts["body"] == body.decode()


def test_another_kind_of_server_is_told_as_such(peer, reply):
    peer.answer = lambda _: reply(body=b"<html>hello</html>")
    with Client(peer.url) as client:
        for ask in (client.info, client.ready, client.options, lambda: list(client.jobs())):
            with pytest.raises(ConnectionFailed, match="with a body that is not a"):
                ask()


def test_readiness_of_no_server_is_a_sentence():
    with Client("http://127.0.0.1:9") as client, pytest.raises(ConnectionFailed, match="splatmill up"):
        client.ready()


def test_no_server_is_a_sentence():
    with (
        Client("http://127.0.0.1:9", retries=1) as client,
        pytest.raises(ConnectionFailed, match="splatmill up"),
    ):
        client.info()


def test_the_key_travels_in_a_header_only(peer, reply, monkeypatch):
    peer.answer = lambda _: reply(body=JOB_BYTES)
    with Client(peer.url, api_key="s3cret") as client:
        client.job("j1")
    monkeypatch.setenv("SPLATMILL_API_KEY", "from-env")
    monkeypatch.setenv("SPLATMILL_SERVER", peer.url)
    with Client() as client:
        client.job("j1")
    with Client(api_key="") as client:
        client.job("j1")
    assert [request.headers.get("authorization") for request in peer.requests] == [
        "Bearer s3cret",
        "Bearer from-env",
        None,
    ]
    assert not any("s3cret" in request.path or "from-env" in request.path for request in peer.requests)


@pytest.mark.parametrize(
    "address", ["http://key@host", "http://host?key=1", "ftp://host", "host:80", "", "http://"]
)
def test_addresses_that_are_refused(address, monkeypatch):
    monkeypatch.setenv("SPLATMILL_SERVER", "nonsense")
    with pytest.raises(ValueError, match=r"address of (a|the) server"):
        Client(address)


@pytest.mark.parametrize(
    ("server", "path"),
    [
        ("https://lab.example", "/splats/s/a"),
        ("https://lab.example/", "/splats/s/a"),
        ("https://lab.example/splats", "/s/a"),
        ("https://lab.example/splats/", "/s/a"),
        ("https://lab.example/spl", "/splats/s/a"),
    ],
)
def test_addresses_in_answers_are_below_the_servers_own(server: str, path: str) -> None:
    assert own_path(server, "/splats/s/a") == path
    assert own_path(server, "/s/a") == "/s/a"  # of a server that does not know where a proxy has put it


def test_a_proxy_does_not_stand_before_this_machine(peer, reply, monkeypatch):
    peer.answer = lambda _: reply(body=JOB_BYTES)
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    with Client(peer.url) as client:
        assert client.job("j1").id == "j1"


def test_a_server_that_asks_for_patience_gets_it(peer, reply, monkeypatch):
    waits: list[float] = []

    async def note(seconds: float) -> None:
        waits.append(seconds)

    monkeypatch.setattr("splatmill.transfer.connection.asyncio.sleep", note)
    peer.script(reply(status=503, headers={"Retry-After": "7"}), reply(body=JOB_BYTES))
    with Client(peer.url) as client:
        client.job("j1")
    assert waits == [7.0]


def test_closing_twice_is_closing_once(peer):
    client = Client(peer.url, timeout=httpx.Timeout(1))
    client.close()
    client.close()
