"""The API process of the embedded service: uvicorn on a socket that the supervisor has opened.

The supervisor keeps the socket open, so the port stays taken and requests wait while the API is restarted.
"""

import socket
import sys

from splatmill.garbage import uncollected

STOP_SECONDS = 3
"""Seconds for which running requests may continue after a signal to stop; event streams end at once."""


def main(descriptor: int) -> None:
    """Serve on the listening socket with this file descriptor until a signal arrives."""
    with uncollected():
        import uvicorn

        from splatmill.backplane.rendering import IDLE_TIMEOUT
        from splatmill_server.__main__ import Server, allow_open_files, configure_logging
        from splatmill_server.app import create_app
        from splatmill_server.base.settings import Settings
        from splatmill_server.base.tls import uvicorn_options

    allow_open_files()
    listener = socket.socket(fileno=descriptor)
    address = listener.getsockname()
    # The supervisor has opened the socket; whether other machines reach it does not follow from SPLATMILL_HOST.
    settings = Settings(host=address[0]) if isinstance(address, tuple) else Settings()
    configure_logging(settings.log_format)
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=STOP_SECONDS,
        timeout_keep_alive=IDLE_TIMEOUT,
        **uvicorn_options(settings),
    )
    Server(config, app).run(sockets=[listener])


if __name__ == "__main__":
    main(int(sys.argv[1]))
