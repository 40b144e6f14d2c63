"""The option --server, and the client it stands for."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from splatmill.client import Client

ServerOption = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        envvar="SPLATMILL_SERVER",
        help="Address of the server. Left out, the server on this machine. The API key is read from "
        "SPLATMILL_API_KEY.",
    ),
]


def open_client(server: str | None) -> "Client":
    """Return a client of `server`, or of the server on this machine."""
    from splatmill.client import Client
    from splatmill.connection import DEFAULT_SERVER

    try:
        return Client(server or DEFAULT_SERVER)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--server") from error
