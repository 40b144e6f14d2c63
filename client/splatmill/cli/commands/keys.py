"""`splatmill keys`: creates, lists, revokes and rotates the keys of a server."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from splatmill.cli.display.tables import JsonLines, local_time, print_list
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Key, KeyWithSecret

keys = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Create, list, revoke and rotate API keys.",
)

KeyId = Annotated[str, typer.Argument(metavar="KEY", help="Id of the key.", show_default=False)]


@keys.command()
def create(
    name: Annotated[str, typer.Argument(help="What people call the key.", show_default=False)],
    owner: Annotated[
        str, typer.Option(help="To whom belongs what is made with the key. Several keys may have one owner.")
    ] = "default",
    scope: Annotated[
        Literal["read", "train", "admin"],
        typer.Option(help="What the key permits; train includes read, and admin is everything."),
    ] = "train",
    jobs: Annotated[
        int | None, typer.Option(min=0, help="Jobs of the owner that may be unfinished at once.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--bytes", help="Storage that the owner's records may occupy, such as 20GB."),
    ] = None,
    requests: Annotated[int | None, typer.Option(min=1, help="Requests with this key a minute.")] = None,
    server: ServerOption = None,
) -> None:
    """Create a key, and print its secret, which the server cannot show again."""
    from splatmill.schema import parse_bytes

    try:
        limits = {
            "unfinished_jobs": jobs,
            "bytes_stored": parse_bytes(size),
            "requests_per_minute": requests,
        }
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--bytes") from error
    with open_client(server) as client:
        _show(client.keys.create(name, owner=owner, scopes=[scope], limits=limits))


@keys.command("list")
def list_keys(server: ServerOption = None, as_json: JsonLines = False) -> None:
    """List the keys, the oldest first, without their secrets."""
    with open_client(server) as client:
        listed = client.keys.list()
    none = "There are no stored keys. Create one with: splatmill keys create NAME --scope admin"
    print_list(listed, as_json, ("key", "name", "owner", "scopes", "limits", "created"), _row, none)


@keys.command()
def revoke(key_id: KeyId, server: ServerOption = None) -> None:
    """Revoke a key. Every process of the server refuses it within two seconds."""
    with open_client(server) as client:
        client.keys.revoke(key_id)
    typer.echo(f"The key {key_id} is revoked.")


@keys.command()
def rotate(
    key_id: KeyId,
    grace: Annotated[
        str,
        typer.Option(
            help="For how long the former secret stays valid: seconds, or a text such as 90s, 5m, 1h30m."
        ),
    ] = "0",
    server: ServerOption = None,
) -> None:
    """Give a key a new secret, and print it. The former one is refused at once, or after --grace."""
    with open_client(server) as client:
        _show(client.keys.rotate(key_id, grace=grace))


def _row(key: "Key") -> tuple[str, ...]:
    """Return the row of a key in the list."""
    limits = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in key.limits if value is not None)
    scopes = ", ".join(scope.value for scope in key.scopes)
    return key.id, key.name, key.owner, scopes, limits or "none", local_time(key.created_at)


def _show(key: "KeyWithSecret") -> None:
    """Print the secret alone to standard output, so that a script can take it, and the rest to standard error."""
    scopes = ", ".join(scope.value for scope in key.scopes)
    typer.echo(f"Key {key.id} ({key.name}) of the owner {key.owner} with the scopes {scopes}.", err=True)
    if key.former_valid_until is not None:
        typer.echo(
            f"The former secret is valid until {key.former_valid_until.astimezone():%Y-%m-%d %H:%M:%S}.",
            err=True,
        )
    typer.echo("This is its secret, which the server cannot show again:", err=True)
    typer.echo(key.secret)
