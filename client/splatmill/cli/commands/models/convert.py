"""`splatmill convert`: a model file in other formats, and what it loses in them, on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from splatmill.cli.local.programs import exec_module, require


def convert(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file to convert.", show_default=False)
    ],
    outs: Annotated[
        list[Path],
        typer.Argument(
            metavar="OUT...", help="Files to write; their suffixes choose the formats.", show_default=False
        ),
    ],
    photos: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the photos, to compare with those that were held out. Left out, those in held_out/ beside "
            "MODEL. Without photos, views after the conversion are compared with views before it.",
        ),
    ] = None,
) -> None:
    """Convert a model file, and print bytes and PSNR of every file.

    The views are those of the cameras.json beside MODEL; without one, the cameras circle the scene.
    """
    from splatmill.schema.files.formats import MODEL_FORMATS, format_of

    if not model.is_file():
        raise typer.BadParameter(f"There is no file {model}.", param_hint="MODEL")
    model_format = format_of(model.name)
    if model_format is None or not model_format.readable:
        known = ", ".join(suffix for suffix, form in MODEL_FORMATS.items() if form.readable)
        raise typer.BadParameter(f"{model} must end in one of {known}.", param_hint="MODEL")
    for out in outs:
        model_format = format_of(out.name)
        if model_format is None or not model_format.writable:
            known = ", ".join(suffix for suffix, form in MODEL_FORMATS.items() if form.writable)
            raise typer.BadParameter(f"{out} must end in one of {known}.", param_hint="OUT")
    if photos is not None and not photos.is_dir():
        raise typer.BadParameter(f"There is no folder {photos}.", param_hint="--photos")
    require("splatmill_worker", "Converting a model")
    photo_arguments = ("--photos", str(photos)) if photos is not None else ()
    exec_module("splatmill_worker", "convert-file", *photo_arguments, "--", str(model), *map(str, outs))
