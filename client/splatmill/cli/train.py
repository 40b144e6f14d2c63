"""`splatmill train`: trains a model from photos, on a server or on this machine."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from splatmill.cli.embedded import embedded_service
from splatmill.cli.exits import Exit
from splatmill.cli.follow import StoppedWaiting, follow_job
from splatmill.cli.models import download_files, write_novel_view
from splatmill.cli.progress import make_display
from splatmill.cli.schema_options import with_training_options
from splatmill.cli.servers import open_client
from splatmill.client import Client, ModelHandle
from splatmill.errors import JobCancelled
from splatmill.local_capture import Found, find_files
from splatmill.schema import Capture, Role, TrainOptions, format_bytes


@with_training_options
def train(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="Folder of photos, zip archive, video, or posed data set.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the results; created if missing.")
    ] = Path("splat"),
    server: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            envvar="SPLATMILL_SERVER",
            help="Address of a server to train on. Left out, this machine trains. The API key is read from "
            "SPLATMILL_API_KEY.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the job. Left out, that of PATH.", show_default=False)
    ] = None,
    detach: Annotated[
        bool,
        typer.Option("--detach", help="Start the job on --server, print its id, and do not wait for it."),
    ] = False,
    orbit: Annotated[
        bool, typer.Option("--orbit", help="Also write orbit.mp4, a video that circles the scene.")
    ] = False,
    novel_view: Annotated[
        bool,
        typer.Option(
            "--novel-view", help="Also write novel_view.png, an image from half-way between two cameras."
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Show the plan and all log lines.")
    ] = False,
    **options: Any,
) -> None:
    """Train Gaussian splats from photos; write model.ply and its report to DIR."""
    from splatmill.aio import train_options, with_start_model

    given = {key: value for key, value in options.items() if value is not None and value != []}
    given, start = with_start_model(given, path)
    checked = train_options(given)
    found = find_files(path)
    if detach and server is None:
        raise typer.BadParameter(
            "--detach needs --server: without a server, the job ends with this command.",
            param_hint="--detach",
        )
    out.mkdir(parents=True, exist_ok=True)
    _announce(found)
    with _sigterm_as_interrupt(), _client(server, out) as client:
        title = name or path.expanduser().resolve().name
        capture = _upload(client, path, title, start)
        if detach:
            typer.echo(client.submit(capture.id, checked, name=title).id)
            return
        model = _follow(client, capture, title, checked, verbose)
        written = download_files(model, out)
        if novel_view:
            written.append(write_novel_view(model, out / "novel_view.png"))
        if orbit:
            written.append(model.orbit(out / "orbit.mp4"))
    _summary(model, written)


def _announce(found: Found) -> None:
    photos, poses, masks = (found.count(role) for role in (Role.images, Role.poses, Role.masks))
    extra = "".join(f", {count} {kind}" for count, kind in ((masks, "masks"), (poses, "pose files")) if count)
    typer.echo(f"{photos} photos{extra}, {format_bytes(found.bytes)}")
    if found.ignored:
        shown = ", ".join(found.ignored[:5]) + (", ..." if len(found.ignored) > 5 else "")
        typer.echo(f"ignored: {shown}")


@contextmanager
def _client(server: str | None, out: Path) -> Iterator[Client]:
    if server is not None:
        with open_client(server) as client:
            yield client
        return
    with (
        embedded_service(out / ".splatmill") as service,
        Client(service.url, api_key=service.api_key) as client,
    ):
        yield client


def _upload(client: Client, path: Path, name: str, start: Path | None) -> Capture:
    with make_display() as display:
        capture, uploaded = client.upload(path, name=name, on_progress=display.progress, model=start)
    for photo, problem in uploaded.refused:
        typer.echo(f"left out: {photo}: {problem.detail}", err=True)
    return capture


def _follow(client: Client, capture: Capture, name: str, options: TrainOptions, verbose: bool) -> ModelHandle:
    try:
        return follow_job(lambda: client.submit(capture.id, options, name=name), verbose=verbose)
    except JobCancelled as cancelled:
        typer.echo(f"The job {cancelled.job_id} was cancelled.")
    except StoppedWaiting:
        typer.echo("The job is being cancelled; this command does not wait for its end.", err=True)
    raise typer.Exit(Exit.cancelled)


def _summary(model: ModelHandle, written: list[Path]) -> None:
    record = model.model
    quality = f", held-out PSNR {record.psnr:.2f} dB" if record.psnr is not None else ""
    quality += f", SSIM {record.ssim:.3f}" if record.ssim is not None else ""
    typer.echo(f"{record.gaussians:,} Gaussians, {format_bytes(record.bytes)}{quality}")
    for path in written:
        typer.echo(f"  {path}")
    typer.echo(
        "To view it, drop model.ply on https://superspl.at/editor, or open it in any viewer for "
        "Gaussian splats."
    )


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Handle SIGTERM (`kill`, a container that is stopped) like Ctrl-C, so that the embedded service is stopped."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
