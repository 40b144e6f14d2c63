"""`splatmill clean`: a model file without what its photos do not support, on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from splatmill.cli.commands.models.models import Box
from splatmill.cli.local.programs import exec_module, require


def clean(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file to clean.", show_default=False)],
    out: Annotated[
        Path,
        typer.Option("-o", "--out", metavar="FILE", help="File to write; its suffix chooses the format."),
    ] = Path("cleaned.ply"),
    capture: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the photos: remove what they do not support. The cameras are those in the folder (COLMAP, "
            "nerfstudio, Blender), or in the cameras.zip beside MODEL.",
            show_default=False,
        ),
    ] = None,
    box: Box = None,
    min_weight: Annotated[
        float | None,
        typer.Option(
            help="Keep the Gaussians whose blending weights sum to this many pixels in some photo. The cameras are "
            "those of --capture, or in the cameras.json beside MODEL.",
            min=0.0,
            show_default=False,
        ),
    ] = None,
    image_size: Annotated[
        int | None,
        typer.Option(
            help="Longest side of the photos in pixels. Left out, that of the cameras.json beside MODEL, or 960.",
            min=16,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a model file without Gaussians that its photos do not support, and print how many went for what reason."""
    from splatmill.errors import valid_request
    from splatmill.schema import EditModel
    from splatmill.schema.files.formats import MODEL_FORMATS, format_of

    if capture is None and box is None and min_weight is None:
        raise typer.BadParameter("Say what to clean by: give --capture, --box or --min-weight.")
    if not model.is_file():
        raise typer.BadParameter(f"There is no file {model}.", param_hint="MODEL")
    if capture is not None and not capture.is_dir():
        raise typer.BadParameter(f"There is no folder {capture}.", param_hint="--capture")
    for path, hint in ((model, "MODEL"), (out, "--out")):
        model_format = format_of(path.name)
        usable = {
            s for s, form in MODEL_FORMATS.items() if (form.readable if path is model else form.writable)
        }
        if model_format is None or model_format.suffix not in usable:
            raise typer.BadParameter(
                f"{path} must end in one of {', '.join(sorted(usable))}.", param_hint=hint
            )
    arguments: list[str] = []
    if box is not None:
        edit = valid_request(EditModel, {"box": {"min": box[:3], "max": box[3:]}}, "option_out_of_range")
        arguments += ["--edit", edit.model_dump_json(exclude_none=True)]
    if capture is not None:
        arguments += ["--capture", str(capture)]
    if min_weight is not None:
        arguments += ["--min-weight", repr(min_weight)]
    if image_size is not None:
        arguments += ["--image-size", str(image_size)]
    require("splatmill_worker", "Cleaning a model")
    exec_module("splatmill_worker", "clean-file", "--out", str(out), *arguments, "--", str(model))
