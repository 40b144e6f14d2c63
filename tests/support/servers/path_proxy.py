"""A reverse proxy that publishes a server below a path, as nginx and Caddy do it: with the path stripped from what it
passes on, or kept."""

import contextlib
import http.client
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HOP_BY_HOP = {"connection", "keep-alive", "transfer-encoding"}


@contextlib.contextmanager
def path_proxy(
    port: int,
    prefix: str = "/splats",
    *,
    strip: bool,
    host: bool = True,
    sent: dict[str, str] | None = None,
) -> Iterator[str]:
    """Publish the server on this port of 127.0.0.1 below `prefix`; yields its new address, without a slash at the end.

    host: whether the header Host is passed on, or replaced by the address of the server, as nginx does unless told.
    sent: headers that the proxy sets.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def pass_on(self) -> None:
            if not self.path.startswith(prefix + "/"):
                self.send_error(404)
                return
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            headers = {name: value for name, value in self.headers.items() if name.lower() not in HOP_BY_HOP}
            if not host:
                headers["Host"] = f"127.0.0.1:{port}"
            headers |= {"X-Forwarded-For": self.client_address[0], **(sent or {})}
            behind = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
            with contextlib.closing(behind):
                path = self.path.removeprefix(prefix) if strip else self.path
                behind.request(self.command, path, body or None, headers)
                answer = behind.getresponse()
                self.send_response_only(answer.status)
                for name, value in answer.getheaders():
                    if name.lower() not in HOP_BY_HOP:
                        self.send_header(name, value)
                # Without a length, as of a stream of events, the end of the connection is that of the body.
                self.close_connection = answer.getheader("Content-Length") is None
                if self.close_connection:
                    self.send_header("Connection", "close")
                self.end_headers()
                with contextlib.suppress(ConnectionError):
                    while chunk := answer.read1(65536):
                        self.wfile.write(chunk)
                        self.wfile.flush()

        def log_message(self, format: str, *args: Any) -> None: ...

    for method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"):
        setattr(Handler, f"do_{method}", Handler.pass_on)
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}{prefix}"
        finally:
            server.shutdown()
