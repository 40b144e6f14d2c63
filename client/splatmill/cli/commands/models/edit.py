"""`splatmill edit`: a new model that leaves out a part of another."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.commands.models.models import Box, ModelId
from splatmill.cli.display.tables import JsonRecord
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import Edited


def edit(
    model_id: ModelId,
    box: Box = None,
    min_opacity: Annotated[
        float | None,
        typer.Option(help="Keep the Gaussians of at least this opacity, 0 to 1.", show_default=False),
    ] = None,
    max_size: Annotated[
        float | None,
        typer.Option(
            help="Keep the Gaussians whose standard deviation is at most this along every axis, in units of the model.",
            show_default=False,
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the new model. Left out, that of MODEL.", show_default=False)
    ] = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Only measure what the edit does; no model is made.")
    ] = False,
    server: ServerOption = None,
    as_json: JsonRecord = False,
) -> None:
    """Make a new model of a part of MODEL, which is kept, and print its error on held-out photos before and after.

    Of a crop there is no error: the photos show what is left out.
    """
    if box is None and min_opacity is None and max_size is None:
        raise typer.BadParameter("Say what to leave out: give --box, --min-opacity or --max-size.")
    corners = {"min": box[:3], "max": box[3:]} if box is not None else None
    with open_client(server) as client:
        done = client.model(model_id).edit(
            box=corners, min_opacity=min_opacity, max_size=max_size, name=name, preview=preview
        )
    if as_json:
        typer.echo(done.model_dump_json(indent=2, exclude_none=True))
        return
    typer.echo(_summary(done))
    if done.model is not None:
        typer.echo(f"model {done.model}")


def _summary(done: "Edited") -> str:
    """What an edit did, or would do, as a sentence."""
    verb = "would be" if done.model is None else "are"
    left_out = (
        f"{done.gaussians_before - done.gaussians:,} of {done.gaussians_before:,} Gaussians {verb} left out"
    )
    if done.crops and done.psnr is not None:
        return f"{left_out}. The photos show what is left out, so they do not measure what is left."
    if done.psnr is None or done.psnr_before is None:
        return f"{left_out}. There are no held-out photos to measure the error on."
    photos = "1 held-out photo" if len(done.views) == 1 else f"{len(done.views)} held-out photos"
    return f"{left_out}. PSNR on {photos}: {done.psnr_before:.2f} dB before, {done.psnr:.2f} dB after."
