"""The question of the supervisor whether its API is ready."""

import http.client
import os
import select
import ssl


class Readiness:
    """Asks `GET /readyz` of the API behind a listening socket of this machine.

    A question waits in the queue of that socket while the API starts, and no other is asked until it is answered: an
    API answers those that have been given up too, and looks for the renderer each time. With TLS, a connection that the
    API does not accept within two seconds is given up before anything is asked.

    address: host and port on which the socket listens.
    """

    def __init__(self, address: tuple[str, int]) -> None:
        host, self._port = address
        self._host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        self._asked: http.client.HTTPConnection | None = None

    def ask(self, seconds: float = 2.0) -> tuple[int, bytes]:
        """Wait for an answer for some seconds, and return its status and body; 0 and nothing if there is none."""
        answer = 0, b""
        try:
            if self._asked is None:
                self._asked = self._connection()
                self._asked.request("GET", "/readyz", headers={"Connection": "close"})
            if not select.select([self._asked.sock], [], [], seconds)[0]:
                return answer
            response = self._asked.getresponse()
            answer = response.status, response.read()
        except OSError:
            pass  # the API has died, or does not speak yet
        self.close()
        return answer

    def close(self) -> None:
        """Give up a question that is not answered."""
        if self._asked is not None:
            self._asked.close()
            self._asked = None

    def _connection(self) -> http.client.HTTPConnection:
        if os.environ.get("SPLATMILL_TLS_CERTIFICATE"):
            # The socket is our own, whatever names the certificate is for.
            return http.client.HTTPSConnection(self._host, self._port, timeout=2, context=_unchecked())
        return http.client.HTTPConnection(self._host, self._port, timeout=2)


def _unchecked() -> ssl.SSLContext:
    """Return a context for TLS that accepts any certificate."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context
