"""Images, videos and conversions of a model file on this machine: the worker part makes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from splatmill.cli.local.programs import exec_module, require
from splatmill.schema.files.formats import MODEL_FORMATS, format_of

if TYPE_CHECKING:
    from splatmill.schema import CameraSpec, ModelCamera


def is_local(model: str) -> bool:
    """Return whether a command is given the path of a model file, and not the id of a model. Ids have no suffix.

    Raises BadParameter for a file that is there and has another suffix.
    """
    model_format = format_of(model)
    if model_format is not None and model_format.readable:
        return True
    if Path(model).is_file():
        known = ", ".join(suffix for suffix, form in MODEL_FORMATS.items() if form.readable)
        raise typer.BadParameter(f"{model} must end in one of {known}.", param_hint="MODEL")
    return False


def local_cameras(model: Path) -> "list[ModelCamera]":
    """Return the cameras in the cameras.json beside a model; none, with a sentence, if it has none that can be read."""
    from pydantic import ValidationError

    from splatmill.schema import ModelCameras

    if not model.is_file():
        raise typer.BadParameter(f"There is no file {model}.", param_hint="MODEL")
    path = _cameras_path(model)
    if not path.is_file():
        typer.echo(f"There is no cameras.json beside {model}.", err=True)
        return []
    try:
        return ModelCameras.model_validate_json(path.read_bytes()).cameras
    except ValidationError:
        typer.echo(f"{path} is not used: it was not written by Splatmill.", err=True)
        return []


def render_local(
    model: Path,
    out: Path,
    options: Mapping[str, Any],
    camera: "CameraSpec | None",
    width: int | None,
    up: str,
) -> NoReturn:
    """Render an image of a model file and end. Without a camera, it shows the dense middle of the scene from the side.

    options: output, format and background of `RenderRequest`.
    """
    from splatmill.errors import valid_request
    from splatmill.schema import CameraSpec, RenderRequest

    shown = camera or CameraSpec.looking_at((1, 0, 0), (0, 0, 0), width=16, height=16)
    request = valid_request(RenderRequest, {**options, "camera": shown}, "camera_invalid")
    if camera is None:
        typer.echo(f"The image shows the dense middle of the scene from the side, with {up} up.", err=True)
    body = request.model_dump_json(exclude_none=True, exclude={"camera"} if camera is None else None)
    size = ("--width", str(width)) if width is not None else ()
    _run("render-file", model, out, body, up, *size)


def orbit_local(
    model: Path, out: Path, options: Mapping[str, Any], *, with_cameras: bool, up: str
) -> NoReturn:
    """Render a video that circles the scene of a model file and end. `options` are fields of `OrbitRequest`."""
    from splatmill.errors import valid_request
    from splatmill.schema import OrbitRequest

    request = valid_request(OrbitRequest, options)
    if not with_cameras and request.camera_path is None:
        typer.echo(f"The camera circles the dense middle of the scene, with {up} up.", err=True)
    cameras = ("--cameras", str(_cameras_path(model))) if with_cameras else ()
    _run("orbit-file", model, out, request.model_dump_json(exclude_none=True), up, *cameras)


def _cameras_path(model: Path) -> Path:
    return model.with_name("cameras.json")


def _run(program: str, model: Path, out: Path, request: str, up: str, *more: str) -> NoReturn:
    require("splatmill_worker", "Rendering a file on this machine")
    options = ("--out", str(out), "--request", request, f"--up={up}", *more)
    exec_module("splatmill_worker", program, *options, "--", str(model))
