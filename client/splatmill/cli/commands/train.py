"""`splatmill train`: trains a model from photos, on a server or on this machine."""

import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splatmill.cli.commands.models.mesh import write_mesh
from splatmill.cli.commands.models.models import download_files, print_summary, write_novel_view
from splatmill.cli.display.follow import Interrupted, StoppedWaiting, follow_job
from splatmill.cli.display.progress import make_display
from splatmill.cli.exits import Exit
from splatmill.cli.local.embedded import embedded_service
from splatmill.cli.local.folder_lock import locked
from splatmill.cli.local.unfinished import Unfinished, size_text
from splatmill.cli.schema_options import Photos, with_training_options
from splatmill.cli.servers import open_client
from splatmill.errors import JobCancelled
from splatmill.schema import Capture, TrainOptions, format_bytes
from splatmill.schema.quantities import listed
from splatmill.transfer.local_capture import CaptureFiles, LocalFile, find_files, printable, start_model
from splatmill.transfer.training_options import train_options, with_start_model

if TYPE_CHECKING:
    from splatmill.sdk.client import Client, JobHandle, ModelHandle

DATA = ".splatmill"
"""Name of the folder for the data of a training on this machine, in the folder of its results."""


@with_training_options
def train(
    path: Photos,
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
    priority: Annotated[
        int | None,
        typer.Option(
            min=-100,
            max=100,
            help="On a server, of the jobs of one owner those with a higher priority are run first; 0 if left out.",
            show_default=False,
        ),
    ] = None,
    orbit: Annotated[
        bool, typer.Option("--orbit", help="Also write orbit.mp4, a video that circles the scene.")
    ] = False,
    novel_view: Annotated[
        bool,
        typer.Option(
            "--novel-view", help="Also write novel_view.png, an image from half-way between two cameras."
        ),
    ] = False,
    mesh: Annotated[
        bool,
        typer.Option(
            "--mesh", help="Also write mesh.glb, triangles of the surfaces on which the cameras agree."
        ),
    ] = False,
    fresh: Annotated[
        bool,
        typer.Option(
            "--fresh",
            help="Discard what an interrupted or failed training on this machine left in DIR, and start over.",
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Show the plan and all log lines.")
    ] = False,
    **options: Any,
) -> None:
    """Train Gaussian splats from photos; write model.ply and its report to DIR.

    Without a server, a training that is interrupted (Ctrl-C, kill, power cut) is kept in DIR/.splatmill, and the same
    command continues where it stopped.
    """
    arguments = {key: value for key, value in options.items() if value is not None and value != []}
    if server is None:
        # The embedded service takes this training for a job like any other, but its results have no page.
        arguments.setdefault("time_lapse", "off")
    arguments, start = with_start_model(arguments, path)
    checked = train_options(arguments)
    capture_files = find_files(path)
    capture_files.refuse_one_photo()
    if detach and server is None:
        raise typer.BadParameter(
            "--detach needs --server: without a server, the job ends with this command.",
            param_hint="--detach",
        )
    if fresh and server is not None:
        raise typer.BadParameter(
            "--fresh discards a training on this machine; with --server, every command starts a new job.",
            param_hint="--fresh",
        )
    if priority is not None and server is None:
        raise typer.BadParameter(
            "--priority orders the jobs of a server; without --server, nothing else waits.",
            param_hint="--priority",
        )
    out.mkdir(parents=True, exist_ok=True)
    _announce(capture_files)
    title = name or printable(path.expanduser().resolve().name)

    def outputs(model: "ModelHandle") -> None:
        written = download_files(model, out)
        if novel_view:
            written.append(write_novel_view(model, out / "novel_view.png"))
        if orbit:
            written.append(model.orbit(out / "orbit.mp4"))
        if mesh:
            written.append(write_mesh(model, out / "mesh.glb"))
        print_summary(model, written)

    with _sigterm_as_interrupt():
        if server is None:
            files = [*capture_files.files, *([start_model(start)] if start is not None else [])]
            with _kept_service(out / DATA, path, files, checked, fresh) as (client, unfinished):
                outputs(_train_here(client, unfinished, path, title, checked, start, verbose))
            return
        with open_client(server) as client:
            capture = _upload(client, path, title, start)

            def submit() -> "JobHandle":
                return client.submit(capture.id, checked, name=title, priority=priority or 0)

            if detach:
                typer.echo(submit().id)
                return
            outputs(_follow(submit, verbose))


def _announce(files: CaptureFiles) -> None:
    typer.echo(f"{', '.join(files.contents())}, {format_bytes(files.bytes)}")
    if files.top:
        typer.echo(f"cameras: those in {printable(files.top)}")
    if files.ignored:
        typer.echo(f"ignored: {listed([printable(name) for name in files.ignored])}")
    if files.outputs:
        typer.echo(
            f"results of an earlier training, not read: {listed([printable(name) for name in files.outputs])}"
        )
    for sentence in files.remarks:
        typer.echo(printable(sentence), err=True)
    for name, stored in files.renamed:
        typer.echo(f"renamed: {name!a} is stored as {stored}", err=True)


@contextmanager
def _kept_service(
    data: Path, path: Path, files: list[LocalFile], options: TrainOptions, fresh: bool
) -> "Iterator[tuple[Client, Unfinished]]":
    """Run the service on this machine. Its data is removed when the block succeeds, and kept when it raises."""
    with locked(data) as lock:
        unfinished = Unfinished.open(data, path, files, options, fresh=fresh)
        try:
            with embedded_service(data, lock) as service:
                from splatmill.sdk.client import Client

                with Client(service.url, api_key=service.api_key) as client:
                    yield client, unfinished
        except BaseException:
            if unfinished.trainings:
                typer.echo(
                    f"The training is kept in {data} ({size_text(data)}). The same command continues where it "
                    "stopped; other options use its cameras again; --fresh discards it and starts over.",
                    err=True,
                )
            else:
                shutil.rmtree(data, ignore_errors=True)
            raise
        shutil.rmtree(data, ignore_errors=True)


def _train_here(
    client: "Client",
    unfinished: Unfinished,
    path: Path,
    name: str,
    options: TrainOptions,
    start: Path | None,
    verbose: bool,
) -> "ModelHandle":
    """Go on with the training that an earlier command left, or begin one; return its model."""
    began = datetime.now(UTC)
    unfinished.stop_others(client)
    known = unfinished.capture(client)
    capture = _upload(client, path, name, start, known)

    def job() -> "JobHandle":
        if (same := unfinished.job(client)) is not None:
            typer.echo("going on with the training that was stopped")
            return same
        if known is not None:
            typer.echo("using the stored photos, and their cameras if these were recovered")
        new = client.submit(capture.id, options, name=name)
        unfinished.remember(capture.id, new.id)
        return new

    return _follow(job, verbose, cancels=False, since=began)


def _upload(
    client: "Client", path: Path, name: str, start: Path | None, known: Capture | None = None
) -> Capture:
    with make_display() as display:
        capture, uploaded = client.upload(
            path,
            name=name,
            capture=known.id if known else None,
            on_progress=display.progress,
            model=start,
            resume=True,
        )
    for photo, problem in uploaded.refused:
        typer.echo(f"left out: {printable(photo)}: {problem.detail}", err=True)
    return capture


def _follow(
    start: "Callable[[], JobHandle]", verbose: bool, cancels: bool = True, since: datetime | None = None
) -> "ModelHandle":
    try:
        return follow_job(start, verbose=verbose, cancels=cancels, since=since)
    except JobCancelled as cancelled:
        typer.echo(f"The job {cancelled.job_id} was cancelled.")
    except Interrupted:
        typer.echo("Stopping; the training saves its state. A second Ctrl-C stops it at once.", err=True)
    except StoppedWaiting:
        typer.echo("The job is being cancelled; this command does not wait for its end.", err=True)
    raise typer.Exit(Exit.cancelled)


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
