"""Which server a command talks to, said the same way by all of them."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from splatmill.client import Client

Server = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        envvar="SPLATMILL_SERVER",
        help="Address of the server. The API key is read from SPLATMILL_API_KEY.",
    ),
]


def connect(server: str | None) -> "Client":
    """A client of `server`, or of the one on this machine."""
    from splatmill.client import Client
    from splatmill.connection import DEFAULT_SERVER

    try:
        return Client(server or DEFAULT_SERVER)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--server") from error
