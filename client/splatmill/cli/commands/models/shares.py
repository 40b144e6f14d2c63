"""`splatmill shares`: creates, lists and revokes links to a model."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.commands.models.models import ModelId
from splatmill.cli.display.tables import JsonLines, local_time, print_list
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Share

shares = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Show a model to people without a key, by a link that ends.",
)


@shares.command()
def create(
    model_id: ModelId,
    expires_in: Annotated[
        str, typer.Option(metavar="TIME", help="For how long the link is valid, such as 12h or 30d.")
    ] = "30d",
    name: Annotated[str | None, typer.Option(help="What people call the link.")] = None,
    photos: Annotated[
        bool,
        typer.Option("--photos", help="Give out the held-out photos too, and the report, which shows some."),
    ] = False,
    server: ServerOption = None,
) -> None:
    """Create a link to a model, and print its address, which the server cannot show again."""
    from splatmill.transfer.connection import own_path

    with open_client(server) as client:
        made = client.model(model_id).shares.create(expires_in=expires_in, name=name, photos=photos)
        typer.echo(f"link {made.id}, valid until {made.expires_at:%Y-%m-%d %H:%M} UTC")
        typer.echo(f"{client.server.rstrip('/')}{own_path(client.server, made.path)}")


@shares.command("list")
def list_shares(model_id: ModelId, server: ServerOption = None, as_json: JsonLines = False) -> None:
    """List the links to a model, newest first, without their addresses."""
    with open_client(server) as client:
        listed = client.model(model_id).shares.list()
    none = f"There are no links to this model. Create one with: splatmill shares create {model_id}"
    print_list(listed, as_json, ("link", "name", "state"), _row, none)


def _row(share: "Share") -> tuple[str, ...]:
    """Return the row of a link in the list."""
    state = "revoked" if share.revoked_at else "valid until" if share.active else "expired"
    until = local_time(share.revoked_at or share.expires_at)
    return share.id, share.name or "", f"{state} {until}"


@shares.command()
def revoke(
    model_id: ModelId,
    share_id: Annotated[str, typer.Argument(metavar="LINK", help="Id of the link.", show_default=False)],
    server: ServerOption = None,
) -> None:
    """Revoke a link to a model, at once and for good."""
    with open_client(server) as client:
        client.model(model_id).shares.revoke(share_id)
    typer.echo(f"The link {share_id} is revoked.")
