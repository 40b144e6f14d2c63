"""Requests to addresses of users: which are refused, and that a connection goes to the address that was checked.

The resolver is replaced where a test needs a name; connections, TLS and redirects are real. Not proved here: what is
done with the answers (test_imports, test_webhooks).
"""

import asyncio
import ipaddress
import socket
import ssl
import subprocess
from pathlib import Path
from typing import Any

import pytest

from splatmill_server.base.outgoing import (
    MAX_URL,
    AddressRefused,
    Answer,
    NoAnswer,
    Outgoing,
    allowed_hosts,
    refusal,
)
from tests.support.programs import program
from tests.support.servers.scripted_server import Reply, ScriptedServer


def port_of(peer: ScriptedServer) -> int:
    return int(peer.url.rsplit(":", 1)[1])


def fetch(outgoing: Outgoing, url: str, **more: Any) -> tuple[Answer, bytes]:
    async def run() -> tuple[Answer, bytes]:
        async with outgoing.request("GET", url, **more) as answer:
            return answer, b"".join([chunk async for chunk in answer.chunks])

    return asyncio.run(run())


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """A resolver that knows these names, besides addresses. `asked` under the empty name counts its questions."""
    known: dict[str, list[str]] = {}
    real = socket.getaddrinfo

    def resolve(host: Any, port: Any, *rest: Any, **more: Any) -> Any:
        name = host.decode() if isinstance(host, bytes) else host
        known.setdefault("", []).append(name)
        try:
            ipaddress.ip_address(name)
        except ValueError:
            if name not in known:
                raise socket.gaierror(socket.EAI_NONAME, "unknown") from None
            return [entry for address in known[name] for entry in real(address, port, *rest, **more)]
        return real(host, port, *rest, **more)

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    return known


PRIVATE = [
    "127.0.0.1",
    "127.1.2.3",
    "0.0.0.0",
    "10.1.2.3",
    "172.16.0.1",
    "172.31.255.255",
    "192.168.1.1",
    "169.254.169.254",
    "100.64.0.1",
    "224.0.0.1",
    "239.255.255.255",
    "240.0.0.1",
    "255.255.255.255",
    "192.0.0.1",
    "198.18.0.1",
    "::1",
    "::",
    "fe80::1",
    "fe80::1%eth0",
    "fc00::1",
    "fd12::1",
    "fec0::1",
    "ff02::1",
    "2001:db8::1",
    "::ffff:127.0.0.1",
    "::ffff:8.8.8.8",
    "64:ff9b::7f00:1",
    "64:ff9b::808:808",
    "64:ff9b:1::a00:1",
    "2002:7f00:1::1",
    "2001::1",
    "::127.0.0.1",
    "4000::1",
]


@pytest.mark.parametrize("address", PRIVATE)
def test_addresses_that_are_not_public_are_refused(address: str) -> None:
    assert refusal(address) is not None


@pytest.mark.parametrize(
    "address", ["8.8.8.8", "1.1.1.1", "172.32.0.1", "2606:4700:4700::1111", "2a00:1450::1"]
)
def test_public_addresses_are_not(address: str) -> None:
    assert refusal(address) is None


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1/",
        "http://localhost/",
        "http://2130706433/",
        "http://0x7f.1/",
        "http://017700000001/",
        "http://[::1]/",
        "http://[::ffff:127.0.0.1]/",
        "http://[::ffff:7f00:1]/",
        "http://[64:ff9b::127.0.0.1]/",
        "http://169.254.169.254/latest/meta-data/",
        "http://0/",
        "https://10.0.0.1/",
    ],
)
def test_no_spelling_of_a_private_address_is_used(url: str) -> None:
    with pytest.raises(AddressRefused):
        fetch(Outgoing(), url)


@pytest.mark.parametrize(
    "url",
    [
        "file:///etc/passwd",
        "ftp://example.org/a",
        "gopher://example.org/",
        "//example.org/",
        "example.org/a",
        "http://",
        "http:///a",
        "http://user@example.org/",
        "http://user:secret@example.org/",
        "http://example.org:22/",
        "http://example.org:6379/",
        "http://exa mple.org/",
        "http://example.org/\r\nX: y",
        "http://example.org/" + "a" * MAX_URL,
    ],
)
def test_addresses_of_other_kinds_are_refused(url: str) -> None:
    with pytest.raises(AddressRefused) as refused:
        Outgoing().checked(url)
    assert "secret" not in str(refused.value)


def test_a_name_is_refused_if_any_of_its_addresses_is_private(names: dict[str, list[str]]) -> None:
    names["mixed.example"] = ["8.8.8.8", "10.0.0.7"]
    names["public.example"] = ["8.8.8.8"]
    with pytest.raises(AddressRefused, match=r"mixed\.example is at 10\.0\.0\.7, a private address"):
        fetch(Outgoing(), "http://mixed.example/")
    asyncio.run(Outgoing().check("http://public.example/"))
    with pytest.raises(NoAnswer, match="cannot be resolved"):
        asyncio.run(Outgoing().check("http://unknown.example/"))


def test_the_connection_goes_to_the_checked_address_and_names_the_host(
    names: dict[str, list[str]], peer: ScriptedServer
) -> None:
    names["pinned.example"] = ["127.0.0.1"]
    peer.answer = lambda _: Reply(body=b"here", headers={"X-Kind": "a"})
    outgoing = Outgoing(f"other.example, PINNED.example:{port_of(peer)}")
    answer, body = fetch(outgoing, f"http://pinned.example:{port_of(peer)}/a%20b?c=d#e")
    assert (answer.status, answer.headers["x-kind"], answer.size, body) == (200, "a", 4, b"here")
    assert peer.requests[0].path == "/a%20b?c=d"
    assert peer.requests[0].headers["host"] == f"pinned.example:{port_of(peer)}"
    assert peer.requests[0].headers["accept-encoding"] == "identity"
    # The name was resolved once; a second answer of the resolver would have had no effect.
    assert names[""].count("pinned.example") == 1


def test_redirects_are_followed_a_few_times_and_checked_each_time(
    names: dict[str, list[str]], peer: ScriptedServer
) -> None:
    port = port_of(peer)
    names["localhost"] = ["127.0.0.1"]
    outgoing = Outgoing(f"127.0.0.1:{port}")

    def answer(request: Any) -> Reply:
        target = request.path.removeprefix("/to/")
        return (
            Reply(status=302, headers={"Location": target}) if target != request.path else Reply(body=b"end")
        )

    peer.answer = answer
    assert fetch(outgoing, f"{peer.url}/to//end", redirects=5)[1] == b"end"
    five = "/to/" * 5 + "/end"
    assert fetch(outgoing, peer.url + five, redirects=5)[1] == b"end"
    with pytest.raises(NoAnswer, match="redirects too often"):
        fetch(outgoing, f"{peer.url}/to/{five}", redirects=5)
    for private in (
        "http://127.0.0.1:8080/",
        "http://[::1]/",
        "http://localhost/",
        "file:///etc/passwd",
        "http://a:6379",
    ):
        with pytest.raises(AddressRefused):
            fetch(outgoing, f"{peer.url}/to/{private}", redirects=5)
    # Without redirects, the redirect itself is the answer.
    assert fetch(outgoing, f"{peer.url}/to//end")[0].status == 302


def test_what_does_not_answer_is_named(peer: ScriptedServer) -> None:
    port = port_of(peer)
    outgoing = Outgoing(f"127.0.0.1:{port}, 127.0.0.1:1")
    peer.answer = lambda _: Reply(body=b"x" * 100, cut=50)
    with pytest.raises(NoAnswer, match=r"connection to 127\.0\.0\.1 failed"):
        fetch(outgoing, peer.url)
    peer.answer = lambda _: Reply(dropped=True)
    with pytest.raises(NoAnswer):
        fetch(outgoing, peer.url)
    with pytest.raises(NoAnswer):
        fetch(outgoing, "http://127.0.0.1:1/")

    async def never(_: Any) -> Reply:
        await asyncio.sleep(60)
        return Reply()

    peer.answer = never
    with pytest.raises(NoAnswer, match="did not answer in time"):
        fetch(outgoing, peer.url, read_seconds=0.2)


def test_proxies_of_the_environment_are_not_used(
    peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "https_proxy", "all_proxy", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    peer.answer = lambda _: Reply(body=b"direct")
    assert fetch(Outgoing(f"127.0.0.1:{port_of(peer)}"), peer.url)[1] == b"direct"


def test_certificates_are_read_for_the_first_request_and_named_where_they_cannot_be(
    peer: ScriptedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", "/nonexistent.pem")
    outgoing = Outgoing(f"127.0.0.1:{port_of(peer)}")
    with pytest.raises(NoAnswer, match=r"cannot be read: No such file or directory.*SSL_CERT_FILE"):
        fetch(outgoing, peer.url)


def test_tls_checks_the_certificate_against_the_name(
    names: dict[str, list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    options = "-x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=t -addext subjectAltName=DNS:right.example"
    command = [program("openssl"), "req", *options.split(), "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    names["right.example"] = names["wrong.example"] = ["127.0.0.1"]
    asked: list[str | None] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nok")
        await writer.drain()
        writer.close()

    async def run() -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate, key)
        context.sni_callback = lambda _, name, __: asked.append(name)
        server = await asyncio.start_server(serve, "127.0.0.1", 0, ssl=context)
        port = server.sockets[0].getsockname()[1]
        outgoing = Outgoing(f"right.example:{port},wrong.example:{port}")
        async with outgoing.request("GET", f"https://right.example:{port}/") as answer:
            assert await answer.beginning(100) == b"ok"
        with pytest.raises(NoAnswer, match="certificate"):
            async with outgoing.request("GET", f"https://wrong.example:{port}/"):
                pass
        server.close()

    asyncio.run(run())
    assert asked == ["right.example", "wrong.example"]


def test_the_allowed_hosts_are_names_with_or_without_a_port() -> None:
    hosts = allowed_hosts("a.example, B.example:8000 ,[::1]:80,10.0.0.1")
    assert hosts == {("a.example", None), ("b.example", 8000), ("::1", 80), ("10.0.0.1", None)}
    for wrong in ("http://a.example", "a.example/path", "u@a.example"):
        with pytest.raises(ValueError, match="is not a host"):
            allowed_hosts(wrong)


@pytest.mark.parametrize(
    "url", ["http://xn--/", "http://xn--a.com/", "http://[v1.x]/", f"http://a:{'9' * 1900}/"]
)
def test_an_address_that_python_cannot_read_is_refused(url: str) -> None:
    with pytest.raises(AddressRefused, match="is not an address"):
        Outgoing().checked(url)
    with pytest.raises(AddressRefused, match="is not an address"):
        asyncio.run(Outgoing().check(url))


@pytest.mark.parametrize(
    "location", ["http://xn--/", "//xn--/x", "http://[", "http://a:99999999999", "?" + "a" * 70_000]
)
def test_a_redirect_to_such_an_address_is_refused(peer: ScriptedServer, location: str) -> None:
    peer.answer = lambda _: Reply(status=302, headers={"Location": location})
    outgoing = Outgoing(allow=peer.url.removeprefix("http://"))
    with pytest.raises((AddressRefused, NoAnswer)):
        fetch(outgoing, peer.url, redirects=5)
    assert len(peer.requests) == 1


def test_an_announced_size_of_many_digits_is_an_error_of_the_other_server(peer: ScriptedServer) -> None:
    peer.answer = lambda _: Reply(headers={"Content-Length": "9" * 5000})
    with pytest.raises(NoAnswer):
        fetch(Outgoing(allow=peer.url.removeprefix("http://")), peer.url)
