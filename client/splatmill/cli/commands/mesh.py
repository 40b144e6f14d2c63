"""`splatmill mesh`: triangles of a model file, on this machine."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from splatmill.cli.local.programs import exec_module, require

SUFFIXES = (".glb", ".ply")


def mesh(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.", show_default=False)],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="Mesh to write: .glb or .ply.")
    ] = Path("mesh.glb"),
    faces: Annotated[
        int, typer.Option(min=100, max=20_000_000, help="Most triangles of the mesh.")
    ] = 500_000,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="X Y Z X Y Z",
            help="Build only what lies between these two corners, the lower one first, in units of the model.",
            show_default=False,
        ),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option(
            help="Finest detail, in units of the model. Left out, the size of a pixel at the median depth, or what "
            "memory allows.",
            min=1e-9,
            show_default=False,
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="cameras.json of the model. Left out, the one beside MODEL. Without any, the model is seen from three "
            "rings around its dense middle.",
            show_default=False,
        ),
    ] = None,
    up: Annotated[
        Literal["x", "y", "z", "-x", "-y", "-z"],
        typer.Option("--up", help="Axis that points up in a model without cameras."),
    ] = "-y",
) -> None:
    """Write a mesh of a model file: the surfaces on which its cameras agree, with a colour at each vertex."""
    from pydantic import ValidationError

    from splatmill.errors import invalid_request
    from splatmill.schema import Box
    from splatmill.schema.files.formats import MODEL_FORMATS, format_of

    for path, hint in ((model, "MODEL"), (cameras, "--cameras")):
        if path is not None and not path.is_file():
            raise typer.BadParameter(f"There is no file {path}.", param_hint=hint)
    model_format = format_of(model.name)
    if model_format is None or not model_format.readable:
        usable = sorted(suffix for suffix, form in MODEL_FORMATS.items() if form.readable)
        raise typer.BadParameter(f"{model} must end in one of {', '.join(usable)}.", param_hint="MODEL")
    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out} must end in one of {', '.join(SUFFIXES)}.", param_hint="--out")
    arguments = ["--faces", str(faces), f"--up={up}"]
    if box is not None:
        try:
            part = Box.model_validate({"min": box[:3], "max": box[3:]})
        except ValidationError as error:
            raise invalid_request(error, "option_out_of_range") from error
        arguments += ["--box", part.model_dump_json()]
    if voxel is not None:
        arguments += ["--voxel", repr(voxel)]
    if cameras is not None:
        arguments += ["--cameras", str(cameras)]
    require("splatmill_worker", "Making a mesh")
    exec_module("splatmill_worker", "mesh-file", "--out", str(out), *arguments, "--", str(model))
