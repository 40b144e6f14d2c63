"""`splatmill cameras`: the cameras and points of a model for other tools, from the model's cameras.zip."""

import tempfile
import zipfile
from pathlib import Path
from typing import Annotated, Literal

import typer

from splatmill.cli.servers import ServerOption, open_client

COLMAP = "sparse/0/"
"""Folder of the COLMAP model in cameras.zip."""

PARTS = {"colmap": (COLMAP,), "transforms": ("transforms.json", "points3D.ply"), "colmap-text": (COLMAP,)}
"""What of cameras.zip each format takes: files, and folders that end in a slash."""


def cameras(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL",
            help="Id of a model on the server, or path of a folder with its cameras.zip.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the files; created if missing.")
    ] = Path("cameras"),
    format: Annotated[
        Literal["colmap", "colmap-text", "transforms"],
        typer.Option(
            help="colmap: a binary COLMAP model in sparse/0; colmap-text: the same as text; transforms: "
            "transforms.json with points3D.ply, as nerfstudio reads them."
        ),
    ] = "colmap",
    server: ServerOption = None,
) -> None:
    """Write the cameras and points of a model for another tool. Put the photos into DIR/images."""
    local = Path(model)
    if local.is_dir() or local.suffix:
        path = local / "cameras.zip" if local.is_dir() else local.with_name("cameras.zip")
        if not path.is_file():
            raise typer.BadParameter(f"There is no file {path}.", param_hint="MODEL")
        _write(path, out, format)
        return
    with open_client(server) as client, tempfile.TemporaryDirectory(prefix="splatmill-cameras-") as folder:
        _write(client.model(model).download(Path(folder) / "cameras.zip", file="cameras.zip"), out, format)


def _write(path: Path, out: Path, format: str) -> None:
    """Write the parts of the zip that a format takes, and print their paths."""
    from splatmill.files import atomic_write

    written = []
    try:
        with zipfile.ZipFile(path) as archive:
            names = [
                name
                for name in archive.namelist()
                if any(
                    name == part or (part.endswith("/") and name == part + Path(name).name)
                    for part in PARTS[format]
                )
            ]
            for name in names:
                atomic_write(out / name, archive.read(name))
                written.append(out / name)
    except zipfile.BadZipFile as error:
        raise typer.BadParameter(f"{path} is no zip: {error}.", param_hint="MODEL") from error
    if not written:
        raise typer.BadParameter(
            f"{path} has none of this format: the lens has no counterpart in it.", param_hint="--format"
        )
    if format == "colmap-text":
        from splatmill.cli.local.programs import exec_module, require

        require("splatmill_worker", "A COLMAP model as text")
        exec_module("splatmill_worker", "model-text", str(out / COLMAP))
    for file in written:
        typer.echo(file)
