"""`splatmill captures` and `models`: what the server stores, as a list or one record at a time."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.display.tables import (
    JsonLines,
    local_time,
    print_facts,
    print_list,
    print_record,
    print_table,
)
from splatmill.cli.servers import ServerOption, open_client
from splatmill.schema import ListOrder

if TYPE_CHECKING:
    from splatmill.schema import Capture, Job, Model

Limit = Annotated[int, typer.Option("-n", "--limit", min=1, help="Largest number of records to list.")]
NamePart = Annotated[
    str | None,
    typer.Option("--name", help="List only records whose name contains this text, in any case and accent."),
]

Tag = Annotated[
    str | None,
    typer.Option(
        "--tag", help="List only records with this tag, in any case and accent.", show_default=False
    ),
]
Favourite = Annotated[
    bool | None,
    typer.Option(
        "--favourite/--no-favourite",
        help="List only records with a star, or without one.",
        show_default=False,
    ),
]
Sort = Annotated[
    ListOrder,
    typer.Option(
        "--sort",
        metavar="ORDER",
        help=f"What comes first: {', '.join(ListOrder)}. Size and psnr are those of the model.",
    ),
]

Owner = Annotated[
    str | None,
    typer.Option("--owner", help="List only this owner's records; it needs a key with the scope admin."),
]


def captures(
    capture_id: Annotated[
        str | None, typer.Argument(metavar="CAPTURE", help="Id of a capture to show.", show_default=False)
    ] = None,
    name: NamePart = None,
    owner: Owner = None,
    limit: Limit = 20,
    as_json: JsonLines = False,
    server: ServerOption = None,
) -> None:
    """List the captures, newest first, or show the files of one."""
    with open_client(server) as client:
        if capture_id is not None:
            _show_capture(client.capture(capture_id), as_json)
            return
        listed = list(client.captures(name=name, owner=owner, limit=limit))
    none = "No capture is stored." if name is owner is None else "No capture matches."
    columns = ("capture", "name", "created")
    print_list(
        listed, as_json, columns, lambda one: (one.id, one.name or "", local_time(one.created_at)), none
    )


def models(
    model_id: Annotated[
        str | None, typer.Argument(metavar="MODEL", help="Id of a model to show.", show_default=False)
    ] = None,
    name: NamePart = None,
    tag: Tag = None,
    favourite: Favourite = None,
    sort: Sort = ListOrder.newest,
    owner: Owner = None,
    limit: Limit = 20,
    as_json: JsonLines = False,
    server: ServerOption = None,
) -> None:
    """List the finished models, newest first or as --sort says, or show one with its files."""
    with open_client(server) as client:
        if model_id is not None:
            _show_model(client.model(model_id).model, as_json)
            return
        chosen = client.models(name=name, tag=tag, favourite=favourite, sort=sort, owner=owner, limit=limit)
        listed = list(chosen)
    narrowed = any(one is not None for one in (name, tag, favourite, owner))
    none = "No model matches." if narrowed else "No model is finished."
    print_list(listed, as_json, ("model", "name", "Gaussians", "size", "PSNR", "created"), _row, none)


def _row(model: "Model") -> tuple[str, ...]:
    """Return the row of a model in the list."""
    from splatmill.schema import format_bytes

    psnr = f"{model.psnr:.2f} dB" if model.psnr is not None else ""
    size = format_bytes(model.bytes)
    return model.id, model.name or "", f"{model.gaussians:,}", size, psnr, local_time(model.created_at)


def _show_capture(capture: "Capture", as_json: bool) -> None:
    from splatmill.schema import format_bytes

    if as_json:
        print_record(capture)
        return
    facts = [
        ("capture", capture.id),
        ("name", capture.name or ""),
        ("owner", capture.owner),
        ("created", local_time(capture.created_at)),
        ("files", f"{len(capture.files)}, {format_bytes(sum(file.size for file in capture.files))}"),
    ]
    print_facts(facts)
    if capture.files:
        typer.echo()
        rows = [(file.role.value, file.name, format_bytes(file.size)) for file in capture.files]
        print_table(("role", "file", "size"), rows)


def _show_model(model: "Model", as_json: bool) -> None:
    from splatmill.schema import format_bytes

    if as_json:
        print_record(model)
        return
    facts = [
        ("model", model.id),
        ("name", model.name or ""),
        *label_facts(model),
        ("owner", model.owner),
        ("created", local_time(model.created_at)),
        ("Gaussians", f"{model.gaussians:,}, spherical harmonics of degree {model.sh_degree}"),
        ("held out", _quality(model)),
    ]
    print_facts(facts)
    if model.files:
        typer.echo()
        print_table(("size", "file"), [(format_bytes(file.size), file.name) for file in model.files])


def label_facts(record: "Model | Job") -> list[tuple[str, str]]:
    """Return the tags and the star of a record, each with its name."""
    return [("tags", ", ".join(record.tags)), ("favourite", "yes" if record.favourite else "")]


def _quality(model: "Model") -> str:
    parts = [f"PSNR {model.psnr:.2f} dB"] if model.psnr is not None else []
    parts += [f"SSIM {model.ssim:.3f}"] if model.ssim is not None else []
    return ", ".join(parts)
