"""`splatmill plan`, `unit` and `units`: a scene in tiles, on this machine or on all that share a folder."""

import os
import secrets
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from splatmill.cli.local.programs import exec_module, require
from splatmill.cli.schema_options import Photos, with_training_options
from splatmill.schema import format_bytes
from splatmill.transfer.local_capture import LocalFile, find_files, printable
from splatmill.transfer.training_options import train_options

TILES = 4
"""Tiles of a plan for which no number is given."""


@with_training_options
def plan(
    path: Photos,
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", metavar="DIR", help="Folder of the plan; created if missing.", show_default=False
        ),
    ],
    **options: Any,
) -> None:
    """Plan a scene in tiles: cameras, a coarse model, tiles, their last steps, and the model, each a unit in DIR.

    `splatmill unit DIR` does the units, on this machine and on every other that sees DIR. A plan that is made again
    with other options keeps what does not depend on them. Without `--tiles`, there are four.
    """
    arguments = {key: value for key, value in options.items() if value is not None and value != []}
    checked = train_options({"tiles": TILES} | arguments)
    capture_files = find_files(path)
    capture_files.refuse_one_photo()
    require("splatmill_worker", "Planning a scene")
    typer.echo(f"{', '.join(capture_files.contents())}, {format_bytes(capture_files.bytes)}")
    for sentence in capture_files.remarks:
        typer.echo(printable(sentence), err=True)
    capture = _copied(capture_files.files, out)
    exec_module(
        "splatmill_worker",
        "plan",
        "--capture",
        str(capture),
        "--options",
        checked.model_dump_json(),
        "--",
        str(out),
    )


def unit(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a plan.", show_default=False)],
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="UNIT",
            help="Name of the unit. Left out, units are done until the scene is, beside other processes that do the "
            "same.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Do one unit of a plan, or all that are left."""
    require("splatmill_worker", "Training a scene")
    exec_module("splatmill_worker", "unit", "--", str(folder), *([] if name is None else [name]))


def units(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a plan.", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """List the units of a plan: which are done, failed, running, ready, or wait for others."""
    require("splatmill_worker", "Reading a plan")
    exec_module("splatmill_worker", "units", *(["--json"] if as_json else []), "--", str(folder))


def _copied(files: tuple[LocalFile, ...], plan: Path) -> Path:
    """A new folder in that of a plan with these files: links to them where the file system has links."""
    new = plan / f".capture-{secrets.token_hex(8)}"
    new.mkdir(parents=True)
    try:
        for file in files:
            target = new / file.role.value / file.name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(file.path.resolve(), target)
            except FileExistsError:
                raise
            except OSError:  # another file system, or one without links
                shutil.copyfile(file.path, target)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    return new
