"""`splatmill download`, and what `train` and `follow` write of a model."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.display.transfers import make_transfer_display
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.sdk.client import ModelHandle

ModelId = Annotated[
    str,
    typer.Argument(metavar="MODEL", help="Id of the model, which is that of its job.", show_default=False),
]

Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        metavar="X Y Z X Y Z",
        help="Keep the Gaussians whose centre lies between these two corners, the lower one first, in units of the "
        "model.",
        show_default=False,
    ),
]

FILES = ("model.ply", "report.json", "report.png", "report.html", "cameras.json", "cameras.zip")
"""The files that `train` and `download` write to the output folder."""

OPTIONAL_FILES = ("frame.json", "preview.jpg", "poster.jpg", "progress.mp4")
"""Files that are also written if the model has them."""


def complete_file() -> list[str]:
    """Return the names that complete `--file` in a shell."""
    return [*FILES, *OPTIONAL_FILES]


def download_files(model: "ModelHandle", folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Download the files of the model with these names, or all of them, to `folder`, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    stored = {entry.name for entry in model.model.files}
    chosen = [name for name in FILES if name in stored or not stored]
    chosen += [name for name in OPTIONAL_FILES if name in stored]
    with make_transfer_display() as show:
        return [
            model.download(folder / name, file=name, on_bytes=partial(show, name)) for name in names or chosen
        ]


def complete_format() -> list[str]:
    """Return the keys that complete `--format` in a shell."""
    from splatmill.schema import DOWNLOADS

    return [*DOWNLOADS]


def download_formats(model: "ModelHandle", folder: Path, formats: Sequence[str]) -> list[Path]:
    """Download the model in these file formats to `folder` as `model.sog` and so on, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    with make_transfer_display() as show:
        names = {key: f"model.{key}" for key in formats}
        return [
            model.download_as(key, folder / name, on_bytes=partial(show, name)) for key, name in names.items()
        ]


def print_summary(model: "ModelHandle", written: list[Path]) -> None:
    """Print the size and the quality of a model, and the files written."""
    from splatmill.schema import format_bytes

    record = model.model
    quality = f", held-out PSNR {record.psnr:.2f} dB" if record.psnr is not None else ""
    quality += f", SSIM {record.ssim:.3f}" if record.ssim is not None else ""
    typer.echo(f"{record.gaussians:,} Gaussians, {format_bytes(record.bytes)}{quality}")
    for path in written:
        typer.echo(f"  {path}")
    if any(path.suffix == ".ply" for path in written):
        typer.echo(
            "To view it, drop model.ply on https://superspl.at/editor, or open it in any viewer for "
            "Gaussian splats."
        )


def write_novel_view(model: "ModelHandle", path: Path) -> Path:
    """Write an image to `path`, rendered half-way between two adjacent cameras of the capture; return `path`."""
    from splatmill.files import atomic_write
    from splatmill.schema import CameraSpec

    cameras = [entry.camera for entry in model.cameras()]
    if len(cameras) < 2:
        raise typer.BadParameter(
            "The model has fewer than two cameras, so there is no view between two.",
            param_hint="--novel-view",
        )
    middle = len(cameras) // 2
    atomic_write(path, model.render(CameraSpec.between(cameras[middle - 1], cameras[middle])))
    return path


def download(
    model_id: ModelId,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the files; created if missing.")
    ] = Path("splat"),
    file: Annotated[
        list[str] | None,
        typer.Option(
            "--file",
            metavar="NAME",
            help="Download only this file, such as model.ply or report.html. May be repeated.",
            show_default=False,
            autocompletion=complete_file,
        ),
    ] = None,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="Download the model in this file format only, such as sog, spz or glb. May be repeated.",
            show_default=False,
            autocompletion=complete_format,
        ),
    ] = None,
    server: ServerOption = None,
) -> None:
    """Download a finished model with its report. A download that was interrupted continues where it stopped."""
    with open_client(server) as client:
        model = client.model(model_id)
        written = download_formats(model, out, formats) if formats else []
        if file or not formats:
            written += download_files(model, out, file or ())
        for path in written:
            typer.echo(path)
