"""Requests to addresses that users give: imports and webhooks. No other code of the server opens such connections.

A user must not reach through this server what only the server can reach: itself, its network, the metadata service of a
cloud. So every address that a name resolves to must be public, and the connection goes to an address that was checked:
the code that connects resolves the name itself, and nothing resolves it again. TLS still checks the certificate against
the name. Redirects pass the same checks. Proxies of the environment are not used.

Private hosts are reached only where the setting SPLATMILL_OUTGOING_ALLOW names them.
"""

import asyncio
import ipaddress
import socket
import ssl
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import cached_property

import httpcore
import httpx

from splatmill.schema.headers import read_integer

PORTS = frozenset({80, 443, 8080, 8443})
"""Ports that may be used. Others belong to services that do not speak HTTP and might be confused by it."""

MAX_URL = 2000  # characters
CONNECT_SECONDS = 10.0

_REDIRECTS = frozenset({301, 302, 303, 307, 308})

_PUBLIC_IPV6 = ipaddress.ip_network("2000::/3")
_EMBEDDING = {
    ipaddress.ip_network("2001::/32"): "Teredo",
    ipaddress.ip_network("2002::/16"): "6to4",
    ipaddress.ip_network("::ffff:0:0/96"): "IPv4-mapped",
    ipaddress.ip_network("::/96"): "IPv4-compatible",
    ipaddress.ip_network("64:ff9b::/96"): "NAT64",
    ipaddress.ip_network("64:ff9b:1::/48"): "NAT64",
}
"""IPv6 networks whose addresses hold an IPv4 address, which a router may forward to."""


class OutgoingError(Exception):
    """A request to an address of a user has failed. The message is a sentence for the user."""


class AddressRefused(OutgoingError):
    """The address may not be used."""


class NoAnswer(OutgoingError):
    """The other server cannot be reached, or did not answer as HTTP asks for."""


@dataclass(frozen=True)
class Answer:
    """The answer to a request. `headers` have names in lower case; `url` is where the last redirect led."""

    status: int
    headers: Mapping[str, str]
    url: str
    chunks: AsyncIterator[bytes]

    @property
    def size(self) -> int | None:
        """The announced size of the body in bytes, or None."""
        return read_integer(self.headers.get("content-length"))

    async def beginning(self, limit: int) -> bytes:
        """Return the first bytes of the body, at most `limit`."""
        first = b""
        async for chunk in self.chunks:
            first += chunk
            if len(first) >= limit:
                break
        return first[:limit]


class Outgoing:
    """Sends requests to public addresses, and to the hosts in `allow`: `name` or `name:port`, separated by commas."""

    def __init__(self, allow: str = "") -> None:
        self._allowed = allowed_hosts(allow)

    @cached_property
    def _tls(self) -> ssl.SSLContext:
        """Made with the first request: reading the certificates of the system would take 25 ms of every start.

        Raises NoAnswer.
        """
        try:
            return httpx.create_ssl_context()
        except OSError as error:  # ssl.SSLError is one
            raise NoAnswer(
                f"The certificates to trust cannot be read: {error.strerror or error}. The operator of this server "
                "can check SSL_CERT_FILE and SSL_CERT_DIR in its environment."
            ) from error

    def checked(self, url: str | httpx.URL) -> httpx.URL:
        """Return the parsed address. Raises AddressRefused for one that cannot be allowed, whatever it resolves to."""
        shown = str(url)
        if len(shown) > MAX_URL:
            raise AddressRefused(f"The address has more than {MAX_URL} characters.")
        if not shown.isprintable() or " " in shown:
            raise AddressRefused(f"{shown[:200]!r} contains spaces or control characters.")
        parsed = _parsed(shown)
        if parsed.scheme not in ("http", "https") or not parsed.host:
            raise AddressRefused(
                f"{shown[:200]!r} is not the address of a web server: begin it with https://."
            )
        if parsed.userinfo:
            raise AddressRefused("An address with a user or a password is not used; it would end up in logs.")
        if _port(parsed) not in PORTS and not self._allows(parsed.host, _port(parsed)):
            ports = ", ".join(str(port) for port in sorted(PORTS))
            raise AddressRefused(
                f"The port {_port(parsed)} is not used for outgoing requests; the ports are {ports}."
            )
        return parsed.copy_with(fragment=None)

    async def check(self, url: str) -> None:
        """Raise AddressRefused if the address may not be used now, and NoAnswer if its name does not resolve."""
        parsed = self.checked(url)
        await self.addresses(parsed.host, _port(parsed))

    async def addresses(self, host: str, port: int) -> list[str]:
        """Resolve a name. Raises AddressRefused if any of its addresses is not public, and NoAnswer if it has none."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_SECONDS):
                answers = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except TimeoutError as error:
            raise NoAnswer(
                f"The name {host} was not resolved within {CONNECT_SECONDS:.0f} seconds."
            ) from error
        except (OSError, ValueError) as error:
            raise NoAnswer(f"The name {host} cannot be resolved.") from error
        addresses = list(dict.fromkeys(str(entry[4][0]) for entry in answers))
        if not addresses:
            raise NoAnswer(f"The name {host} has no address.")
        if not self._allows(host, port):
            for address in addresses:
                if (reason := refusal(address)) is not None:
                    raise AddressRefused(f"{host} is at {address}, {reason}, which requests are not sent to.")
        return addresses

    @asynccontextmanager
    async def request(
        self,
        method: str,
        url: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: bytes = b"",
        redirects: int = 0,
        read_seconds: float = 30.0,
    ) -> AsyncIterator[Answer]:
        """Send a request and yield the answer, whose body is read in pieces. At most `redirects` are followed.

        read_seconds: longest wait for the next bytes.

        Raises AddressRefused and NoAnswer, also while the body is read.
        """
        target = self.checked(url)
        seconds = dict.fromkeys(("read", "write"), read_seconds) | dict.fromkeys(
            ("connect", "pool"), CONNECT_SECONDS
        )
        fixed = {
            "User-Agent": "splatmill",
            "Accept": "*/*",
            "Accept-Encoding": "identity",
            "Connection": "close",
        }
        backend = _CheckedBackend(self)
        async with httpcore.AsyncConnectionPool(ssl_context=self._tls, network_backend=backend) as pool:
            for left in range(redirects, -1, -1):
                sent = {"Host": target.netloc.decode("ascii")} | fixed | dict(headers or {})
                sent |= {"Content-Length": str(len(body))} if body else {}
                with _no_answer(target):
                    response = await pool.handle_async_request(
                        httpcore.Request(
                            method,
                            httpcore.URL(
                                scheme=target.raw_scheme,
                                host=target.raw_host,
                                port=target.port,
                                target=target.raw_path,
                            ),
                            headers=list(sent.items()),
                            content=body,
                            extensions={"timeout": seconds},
                        )
                    )
                try:
                    fields = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in response.headers}
                    if response.status in _REDIRECTS and redirects:
                        target = self._redirected(target, fields.get("location", ""), left)
                        continue
                    yield Answer(response.status, fields, str(target), _body(response, target))
                    return
                finally:
                    await response.aclose()

    def _redirected(self, target: httpx.URL, location: str, left: int) -> httpx.URL:
        if not location or left == 0:
            raise NoAnswer(f"{target.host} redirects too often, or nowhere.")
        following = self.checked(_parsed(location, target))
        if target.scheme == "https" and following.scheme == "http":
            raise AddressRefused(f"{target.host} redirects from https to http, which is not followed.")
        return following

    def _allows(self, host: str, port: int) -> bool:
        return bool({(host.lower(), None), (host.lower(), port)} & self._allowed)


def _parsed(address: str, base: httpx.URL | None = None) -> httpx.URL:
    """Return the parsed address, relative to `base`. Raises AddressRefused unless every part of it can be read."""
    try:
        url = httpx.URL(address) if base is None else base.join(address)
        _ = url.host, url.netloc  # httpx decodes a name like xn-- only here
        if (url.port or 0) > 65535:
            raise ValueError("there is no such port")
    except (httpx.InvalidURL, ValueError) as error:
        raise AddressRefused(f"{address[:200]!r} is not an address: {str(error)[:200]}.") from error
    return url


def allowed_hosts(allow: str) -> set[tuple[str, int | None]]:
    """Return the hosts and ports of a setting, with None for all usual ports. Raises ValueError."""
    return {_host_and_port(entry.strip()) for entry in allow.split(",") if entry.strip()}


def refusal(address: str) -> str | None:
    """Return why requests are not sent to an IP address, or None for a public one."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address):
        for network, kind in _EMBEDDING.items():
            if parsed in network and int(parsed) > 1:
                return f"an address of the kind {kind}"
    kinds = {
        "is_loopback": "this machine",
        "is_unspecified": "this machine",
        "is_link_local": "a link-local address",
        "is_multicast": "a multicast address",
        "is_reserved": "a reserved address",
        "is_private": "a private address",
    }
    for attribute, kind in kinds.items():
        if getattr(parsed, attribute):
            return kind
    if not parsed.is_global or (parsed.version == 6 and parsed not in _PUBLIC_IPV6):
        return "an address that is not public"
    return None


class _CheckedBackend(httpcore.AsyncNetworkBackend):
    """Resolves a name, checks all its addresses, and connects to one of these."""

    def __init__(self, outgoing: Outgoing) -> None:
        self._outgoing = outgoing
        self._sockets = httpcore.AnyIOBackend()

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        failed: Exception | None = None
        for address in (await self._outgoing.addresses(host, port))[:4]:
            try:
                return await self._sockets.connect_tcp(address, port, timeout, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as error:
                failed = error
        assert failed is not None
        raise failed

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)


@contextmanager
def _no_answer(url: httpx.URL) -> Iterator[None]:
    """Convert the errors of httpcore and of sockets into NoAnswer."""
    try:
        yield
    except httpcore.TimeoutException as error:
        raise NoAnswer(f"{url.host} did not answer in time.") from error
    except (httpcore.NetworkError, httpcore.ProtocolError, OSError, ValueError) as error:
        raise NoAnswer(f"The connection to {url.host} failed ({_reason(error)}).") from error


async def _body(response: httpcore.Response, url: httpx.URL) -> AsyncIterator[bytes]:
    with _no_answer(url):
        async for chunk in response.aiter_stream():
            yield chunk


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _port(url: httpx.URL) -> int:
    return url.port or (443 if url.scheme == "https" else 80)


def _host_and_port(entry: str) -> tuple[str, int | None]:
    try:
        url = _parsed(f"http://{entry}")
    except AddressRefused as error:
        raise ValueError(f"{entry!r} is not a host.") from error
    if not url.host or url.raw_path != b"/" or url.userinfo:
        raise ValueError(f"{entry!r} is not a host; write it as name or name:port.")
    explicit_80 = entry.endswith(":80")  # httpx leaves out the default port
    return url.host.lower(), 80 if explicit_80 else url.port
