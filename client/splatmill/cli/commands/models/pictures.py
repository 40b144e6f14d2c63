"""`splatmill render` and `orbit`: images and videos of a model on a server, or in a file on this machine."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from splatmill.cli.local.local_model import is_local, local_cameras, orbit_local, render_local
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import CameraPath, CameraSpec, ModelCamera
    from splatmill.sdk.client import ModelHandle

ModelOrFile = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="Id of a model on the server, or path of a file (.ply, .spz, ...), which is rendered on this machine.",
        show_default=False,
    ),
]
Up = Annotated[
    Literal["x", "y", "z", "-x", "-y", "-z"] | None,
    typer.Option(
        "--up",
        help="Axis that points up in a file without a cameras.json beside it. Left out, -y.",
        show_default=False,
    ),
]


def render(
    model_id: ModelOrFile,
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
        str | None,
        typer.Option(
            metavar="NUMBER|FILE",
            help="In place of --view: the number of a camera of the model, from 0, or a JSON file with a camera as in "
            "the API (`CameraSpec`).",
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
        Literal["color", "depth", "median_depth", "normal", "alpha"],
        typer.Option(
            help="What to render: colour, mean depth along the viewing axis, depth of the first surface, its normal, "
            "or opacity."
        ),
    ] = "color",
    background: Annotated[
        Literal["black", "white", "transparent"], typer.Option(help="Colour behind the model.")
    ] = "black",
    up: Up = None,
    server: ServerOption = None,
) -> None:
    """Render an image of a model on a server, or in a file on this machine."""
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
    options: dict[str, Any] = {"output": output, "background": background}
    options["format"] = suffixes[out.suffix.lower()]
    if is_local(model_id):
        path = Path(model_id)
        cameras = local_cameras(path)
        whole = not cameras and view is None and camera is None
        _check_up(up, used=whole)
        chosen = None if whole else _camera(cameras, view, camera, width)
        render_local(path, out, options, chosen, width, up or "-y")
    _check_up(up, used=False)
    with open_client(server) as client:
        model = client.model(model_id)
        stored = [] if _is_file(camera) else model.cameras()
        picture = model.render(_camera(stored, view, camera, width), **options)
    atomic_write(out, picture)
    typer.echo(out)


def orbit(
    model_id: ModelOrFile,
    out: Annotated[Path, typer.Option("-o", "--out", help="Video to write (MP4).")] = Path("orbit.mp4"),
    seconds: Annotated[float, typer.Option(min=0.5, max=60, help="Length of the video in seconds.")] = 6.0,
    fps: Annotated[int, typer.Option(min=1, max=60, help="Frames per second.")] = 24,
    width: Annotated[int, typer.Option(min=16, max=3840, help="Width in pixels; must be even.")] = 640,
    height: Annotated[int, typer.Option(min=16, max=2160, help="Height in pixels; must be even.")] = 480,
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON file with a camera path as in the API (`CameraPath`), to follow in place of a circle.",
            show_default=False,
        ),
    ] = None,
    up: Up = None,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep/--no-keep",
            help="Keep the video with the model on the server. A key with the scope read needs --no-keep.",
        ),
    ] = True,
    server: ServerOption = None,
) -> None:
    """Render a video that circles the scene, or follows a path, of a model on a server or in a file on this machine.

    Ctrl-C cancels the video on the server.
    """
    options: dict[str, Any] = {"seconds": seconds, "fps": fps, "width": width, "height": height}
    if path is not None:
        options["camera_path"] = _read_path(path)
    if is_local(model_id):
        cameras = local_cameras(Path(model_id)) if path is None else []
        _check_up(up, used=not cameras and path is None)
        orbit_local(Path(model_id), out, options, with_cameras=bool(cameras), up=up or "-y")
    _check_up(up, used=False)
    with open_client(server) as client:
        model = client.model(model_id)
        typer.echo(_kept(model, out, options) if keep else model.orbit(out, keep=False, **options))


def _kept(model: "ModelHandle", out: Path, options: dict[str, Any]) -> Path:
    """Let the server render a video, show how far it is, and download it."""
    from splatmill.cli.display.progress import make_display

    begun = model.orbits.start(**options)
    try:
        with make_display() as display:
            model.orbits.wait(begun.id, display.progress)
    except KeyboardInterrupt:
        model.orbits.delete(begun.id)
        raise
    return model.orbits.download(begun.id, out)


def _check_up(up: str | None, *, used: bool) -> None:
    if up is not None and not used:
        raise typer.BadParameter(
            "--up is for a file without cameras; the cameras of this model say where up is.",
            param_hint="--up",
        )


def _is_file(camera: str | None) -> bool:
    return camera is not None and not camera.isdigit()


def _camera(
    cameras: "list[ModelCamera]", view: str | None, camera: str | None, width: int | None
) -> "CameraSpec":
    """Return the camera that the options choose, at the given width."""
    if camera is not None and _is_file(camera):
        chosen = _read_camera(Path(camera))
    elif not cameras:
        hint = "--view" if camera is None else "--camera"
        raise typer.BadParameter("The model has no cameras; give a file with --camera.", param_hint=hint)
    elif camera is not None:
        if int(camera) >= len(cameras):
            raise typer.BadParameter(
                f"The model has {len(cameras)} cameras, 0 to {len(cameras) - 1}.", param_hint="--camera"
            )
        chosen = cameras[int(camera)].camera
    elif view is not None:
        named = [entry for entry in cameras if entry.name == view]
        if not named:
            raise typer.BadParameter(
                f"The model has no camera named {view!r}; it has "
                f"{', '.join(c.name for c in cameras[:8])}, ...",
                param_hint="--view",
            )
        chosen = named[0].camera
    else:
        chosen = next((entry for entry in cameras if entry.split == "test"), cameras[0]).camera
    return chosen.scaled_to(width) if width is not None else chosen


def _read_path(path: Path) -> "CameraPath":
    from splatmill.errors import valid_request
    from splatmill.schema import CameraPath

    if not path.is_file():
        raise typer.BadParameter(f"There is no file {path}.", param_hint="--path")
    return valid_request(CameraPath, path.read_bytes())


def _read_camera(path: Path) -> "CameraSpec":
    from splatmill.errors import valid_request
    from splatmill.schema import CameraSpec

    if not path.is_file():
        raise typer.BadParameter(
            f"{path} is neither a file nor the number of a camera.", param_hint="--camera"
        )
    return valid_request(CameraSpec, path.read_bytes(), "camera_invalid")
