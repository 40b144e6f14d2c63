"""`splatmill import`: lets the server fetch a file of a capture from an address."""

from typing import Annotated

import typer

from splatmill.cli.servers import ServerOption, open_client
from splatmill.schema.resources.captures import Role


def import_file(
    url: Annotated[
        str, typer.Argument(metavar="URL", help="Public address of the file.", show_default=False)
    ],
    capture: Annotated[
        str | None,
        typer.Option(help="Id of the capture that gets the file. Left out, a new one.", show_default=False),
    ] = None,
    role: Annotated[Role, typer.Option(help="Purpose of the file in the capture.")] = Role.images,
    name: Annotated[
        str | None,
        typer.Option(help="Name in the capture. Left out, the last part of URL.", show_default=False),
    ] = None,
    sha256: Annotated[
        str | None, typer.Option(help="SHA-256 of the file in hex, to be checked.", show_default=False)
    ] = None,
    server: ServerOption = None,
) -> None:
    """Let the server fetch a photo, a video, a zip or a file of poses from an address; print the capture's id.

    If this command is stopped, the server continues the import.
    """
    from splatmill.cli.display.progress import make_display
    from splatmill.errors import error_for
    from splatmill.schema import format_bytes

    with open_client(server) as client:
        begun = client.imports.start(url, capture=capture, role=role, name=name, sha256=sha256)
        with make_display() as display:
            ended = client.imports.wait(begun.capture, begun.id, display.progress)
    if ended.problem is not None:
        raise error_for(ended.problem)
    if ended.file is not None:
        typer.echo(f"{ended.file.role.value}/{ended.file.name}, {format_bytes(ended.file.size)}")
    typer.echo(f"capture {ended.capture}")
