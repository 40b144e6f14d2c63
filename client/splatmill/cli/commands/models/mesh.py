"""`splatmill mesh`: triangles of a model on a server, or in a file on this machine."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from splatmill.cli.commands.models.pictures import ModelOrFile, Up
from splatmill.cli.local.local_model import is_local
from splatmill.cli.local.programs import exec_module, require
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import MeshRequest
    from splatmill.sdk.client import ModelHandle

SUFFIXES = (".glb", ".ply")


def mesh(
    model: ModelOrFile,
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="Mesh to write: .glb or .ply.")
    ] = Path("mesh.glb"),
    faces: Annotated[int, typer.Option(min=100, max=5_000_000, help="Most triangles of the mesh.")] = 500_000,
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
            help="Finest detail, in units of the model. Left out, the size of a pixel at the median depth.",
            min=1e-9,
            show_default=False,
        ),
    ] = None,
    texture: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help="Longest side of a texture, of a .glb. Left out, each vertex has a colour instead.",
            min=256,
            max=4096,
            show_default=False,
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="cameras.json of a model file. Left out, the one beside it. Without any, the model is seen from three "
            "rings around its dense middle.",
            show_default=False,
        ),
    ] = None,
    up: Up = None,
    server: ServerOption = None,
) -> None:
    """Write a mesh of a model: the surfaces on which its cameras agree, with a colour at each vertex or a texture.

    A file is meshed on this machine. Ctrl-C cancels a mesh on the server.
    """
    from splatmill.errors import valid_request
    from splatmill.schema import MeshRequest

    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out} must end in one of {', '.join(SUFFIXES)}.", param_hint="--out")
    wish: dict[str, Any] = {
        "format": out.suffix.lower()[1:],
        "faces": faces,
        "voxel": voxel,
        "texture": texture,
    }
    if box is not None:
        wish["box"] = {"min": box[:3], "max": box[3:]}
    request = valid_request(MeshRequest, wish, "option_out_of_range")
    if is_local(model):
        _mesh_file(Path(model), out, request, cameras, up or "-y")
    for value, hint in ((cameras, "--cameras"), (up, "--up")):
        if value is not None:
            raise typer.BadParameter(f"{hint} is for a model file.", param_hint=hint)
    with open_client(server) as client:
        typer.echo(write_mesh(client.model(model), out, **wish))


def write_mesh(model: "ModelHandle", out: Path, **wish: Any) -> Path:
    """Let the server make a mesh, show what it does, and download it to `out`.

    wish: the fields of `MeshRequest`.
    """
    from splatmill.cli.display.progress import make_display

    begun = model.meshes.start(**wish)
    try:
        with make_display() as display:
            whole = model.meshes.wait(begun.id, display.progress)
    except KeyboardInterrupt:
        model.meshes.delete(begun.id)
        raise
    if (facts := whole.facts) is not None:
        typer.echo(
            f"{facts.triangles:,} triangles and {facts.vertices:,} vertices from {facts.views} views; voxels of "
            f"{facts.voxel:.4g}."
        )
    return model.meshes.download(begun.id, out)


def _mesh_file(model: Path, out: Path, request: "MeshRequest", cameras: Path | None, up: str) -> NoReturn:
    """Make a mesh of a model file on this machine, and end."""
    for path, hint in ((model, "MODEL"), (cameras, "--cameras")):
        if path is not None and not path.is_file():
            raise typer.BadParameter(f"There is no file {path}.", param_hint=hint)
    arguments = ["--out", str(out), "--faces", str(request.faces), f"--up={up}"]
    if request.box is not None:
        arguments += ["--box", request.box.model_dump_json()]
    if request.voxel is not None:
        arguments += ["--voxel", repr(request.voxel)]
    if request.texture is not None:
        arguments += ["--texture", str(request.texture)]
    if cameras is not None:
        arguments += ["--cameras", str(cameras)]
    require("splatmill_worker", "Making a mesh")
    exec_module("splatmill_worker", "mesh-file", *arguments, "--", str(model))
