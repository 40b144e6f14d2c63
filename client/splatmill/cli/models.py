"""`splatmill download`, `render` and `orbit`: the files of a model, and images and videos of it."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from splatmill.cli.servers import ServerOption, open_client
from splatmill.cli.transfers import make_transfer_display

if TYPE_CHECKING:
    from splatmill.client import ModelHandle
    from splatmill.schema import CameraSpec

ModelId = Annotated[
    str,
    typer.Argument(metavar="MODEL", help="Id of the model, which is that of its job.", show_default=False),
]

FILES = ("model.ply", "report.json", "report.png", "report.html", "cameras.json")
"""The files that `train` and `download` write to the output folder."""

OPTIONAL_FILES = ("preview.jpg", "progress.mp4")
"""Files that are also written if the model has them."""


def complete_file() -> list[str]:
    """Return the names that complete `--file` in a shell."""
    return [*FILES, *OPTIONAL_FILES]


def download_files(model: "ModelHandle", folder: Path, names: Sequence[str] = ()) -> list[Path]:
    """Download the files of the model with these names, or all of them, to `folder`, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    stored = {entry.name for entry in model.model.files}
    wanted = [name for name in FILES if name in stored or not stored]
    wanted += [name for name in OPTIONAL_FILES if name in stored]
    with make_transfer_display() as show:
        return [
            model.download(folder / name, file=name, on_bytes=partial(show, name)) for name in names or wanted
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
    server: ServerOption = None,
) -> None:
    """Download a finished model with its report. A download that was interrupted continues where it stopped."""
    with open_client(server) as client:
        for path in download_files(client.model(model_id), out, file or ()):
            typer.echo(path)


def render(
    model_id: ModelId,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Image to write: .png, .jpg, .webp, or .npy (float32).")
    ] = Path("view.png"),
    view: Annotated[
        str | None,
        typer.Option(
            help="Name of the photo from whose camera to render. Left out, the first held-out photo."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="JSON file with a camera as in the API (`CameraSpec`), in place of --view.",
        ),
    ] = None,
    width: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=8192,
            help="Width in pixels; the aspect ratio stays. Left out, the width of the camera.",
        ),
    ] = None,
    output: Annotated[
        Literal["color", "depth", "alpha"],
        typer.Option(help="What to render: colour, depth along the viewing axis, or opacity."),
    ] = "color",
    background: Annotated[
        Literal["black", "white", "transparent"], typer.Option(help="Colour behind the model.")
    ] = "black",
    server: ServerOption = None,
) -> None:
    """Render an image of a model."""
    from splatmill.files import atomic_write
    from splatmill.schema import Format

    suffixes = {
        ".png": Format.png,
        ".jpg": Format.jpeg,
        ".jpeg": Format.jpeg,
        ".webp": Format.webp,
        ".npy": Format.npy,
    }
    if out.suffix.lower() not in suffixes:
        raise typer.BadParameter(f"{out} must end in one of {', '.join(suffixes)}.", param_hint="--out")
    if camera is not None and view is not None:
        raise typer.BadParameter("Give --view or --camera, not both.", param_hint="--view")
    with open_client(server) as client:
        model = client.model(model_id)
        chosen = _read_camera(camera) if camera is not None else _camera_of_view(model, view)
        if width is not None:
            chosen = chosen.scaled_to(width)
        picture = model.render(
            chosen, output=output, background=background, format=suffixes[out.suffix.lower()]
        )
    atomic_write(out, picture)
    typer.echo(out)


def orbit(
    model_id: ModelId,
    out: Annotated[Path, typer.Option("-o", "--out", help="Video to write (MP4).")] = Path("orbit.mp4"),
    seconds: Annotated[float, typer.Option(min=0.5, max=60, help="Length of the video in seconds.")] = 6.0,
    fps: Annotated[int, typer.Option(min=1, max=60, help="Frames per second.")] = 24,
    width: Annotated[int, typer.Option(min=16, max=3840, help="Width in pixels; must be even.")] = 640,
    height: Annotated[int, typer.Option(min=16, max=2160, help="Height in pixels; must be even.")] = 480,
    server: ServerOption = None,
) -> None:
    """Render a video that circles the scene."""
    with open_client(server) as client:
        model = client.model(model_id)
        typer.echo(model.orbit(out, seconds=seconds, fps=fps, width=width, height=height))


def _camera_of_view(model: "ModelHandle", name: str | None) -> "CameraSpec":
    cameras = model.cameras()
    if name is not None:
        found = [entry for entry in cameras if entry.name == name]
        if not found:
            raise typer.BadParameter(
                f"The model has no camera named {name!r}; it has "
                f"{', '.join(c.name for c in cameras[:8])}, ...",
                param_hint="--view",
            )
        return found[0].camera
    if not cameras:
        raise typer.BadParameter("The model has no cameras; give one with --camera.", param_hint="--view")
    return next((entry for entry in cameras if entry.split == "test"), cameras[0]).camera


def _read_camera(path: Path) -> "CameraSpec":
    from pydantic import ValidationError

    from splatmill.errors import invalid_request
    from splatmill.schema import CameraSpec

    try:
        return CameraSpec.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise invalid_request(error, "camera_invalid") from error
