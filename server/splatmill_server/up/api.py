"""The API child of an embedded service: uvicorn on a socket that its parent opened and keeps.

The parent holds the port, so nobody else can take it while the API is started anew, and requests wait meanwhile.
"""

import socket
import sys

import uvicorn

from splatmill_server.__main__ import Server, configure_logging
from splatmill_server.app import create_app
from splatmill_server.settings import Settings

END_SECONDS = 3
"""Seconds open requests get to end; event streams end at once by themselves."""


def main(descriptor: int) -> None:
    """Serve on the listening socket with this file descriptor until told to stop."""
    configure_logging()
    app = create_app(Settings())
    config = uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=END_SECONDS)
    Server(config, app).run(sockets=[socket.socket(fileno=descriptor)])


if __name__ == "__main__":
    main(int(sys.argv[1]))
