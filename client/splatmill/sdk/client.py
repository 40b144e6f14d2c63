"""The synchronous twins of the classes in `model`, `job`, `aio`.

Generated from these by `make generated`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, Unpack

import httpx

from splatmill.schema import (
    Box,
    CameraSpec,
    Capture,
    CurveRow,
    Edited,
    Estimate,
    EventRecord,
    Info,
    Job,
    JobState,
    LanAccess,
    ListOrder,
    LogLine,
    Me,
    Model,
    ModelCamera,
    ModelDownload,
    OptionHelp,
    Placement,
    Presentation,
    Problem,
    Ready,
    Report,
    Selection,
    StorageUse,
    TrainOptions,
)
from splatmill.sdk.aio import AsyncClient
from splatmill.sdk.arguments import (
    MeshArguments,
    OrbitArguments,
    PresentationArguments,
    RenderArguments,
    TrainArguments,
)
from splatmill.sdk.client_records import Bin, Imports, Keys, Meshes, Orbits, Shares, Webhooks
from splatmill.sdk.job import MOST_LINES, AsyncJobHandle
from splatmill.sdk.loop import BackgroundLoop
from splatmill.sdk.model import AsyncModelHandle
from splatmill.transfer.connection import RETRIES, TIMEOUT
from splatmill.transfer.downloads import AnyPath, OnBytes
from splatmill.transfer.server_choice import Verify
from splatmill.transfer.uploads import OnProgress, Uploaded


class ModelHandle:
    """A finished model on the server."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncModelHandle) -> None:
        self._loop = loop
        self._async = twin
        self.shares = Shares(self._loop, self._async.shares)
        self.orbits = Orbits(self._loop, self._async.orbits)
        self.meshes = Meshes(self._loop, self._async.meshes)

    @property
    def model(self) -> Model:
        """The record of the model."""
        return self._async.model

    @property
    def id(self) -> str:
        """The id of the model."""
        return self._async.id

    def download(self, path: AnyPath, *, file: str = "model.ply", on_bytes: OnBytes | None = None) -> Path:
        """Download a file of the model to `path`, a file or an existing folder, and return the path written.

        A partial download is resumed. `on_bytes` is called with the bytes received and the size, where it is known.
        Raises DownloadFailed, ConnectionFailed, a subclass of `Refused`, or OSError.
        """
        return self._loop.run(self._async.download(path, file=file, on_bytes=on_bytes))

    def formats(self) -> list[ModelDownload]:
        """Return the file formats in which the model can be downloaded, with bytes and quality where they are known."""
        return self._loop.run(self._async.formats())

    def download_as(self, format: str, path: AnyPath, *, on_bytes: OnBytes | None = None) -> Path:
        """Download the model in another file format, such as "sog", to `path`, a file or an existing folder.

        The first download in a format waits until the server has converted the model. Returns the path written.
        Raises NotFound for an unknown format, DownloadFailed, ConnectionFailed, a subclass of `Refused`, or OSError.
        """
        return self._loop.run(self._async.download_as(format, path, on_bytes=on_bytes))

    def rename(self, name: str | None) -> Model:
        """Name the model, and its job with it; None takes the name away. Returns the record."""
        return self._loop.run(self._async.rename(name))

    def label(self, *, tags: Sequence[str] | None = None, favourite: bool | None = None) -> Model:
        """Give the model, and its job with it, these tags in place of those it has, or a star. Returns the record.

        None leaves them as they are. Raises InvalidRequest for more than 12 tags, or ones over 40 characters.
        """
        return self._loop.run(self._async.label(tags=tags, favourite=favourite))

    def delete(self) -> None:
        """Delete the model with its job, its report and its files. The capture is kept."""
        self._loop.run(self._async.delete())

    def cameras(self) -> list[ModelCamera]:
        """Return the cameras of the capture in the coordinates of the model; `split` marks the held-out ones."""
        return self._loop.run(self._async.cameras())

    def presentation(self) -> Presentation:
        """Return how the model is shown to people: its start view, scale, measurements and annotations."""
        return self._loop.run(self._async.presentation())

    def present(self, **changes: Unpack[PresentationArguments]) -> Presentation:
        """Change how the model and its links are shown to people, and return the whole of it.

        `changes` are fields of `Presentation`; those that are left out stay as they are, and None takes the start view
        or the scale away. Another start view makes the server render the picture `poster.jpg`.

        Raises InvalidRequest for values that are not valid.
        """
        return self._loop.run(self._async.present(**changes))

    def render(self, camera: CameraSpec | Mapping[str, Any], **options: Unpack[RenderArguments]) -> bytes:
        """Render an image from `camera`, and return the bytes of the file.

        `options` are output, format, background and quality of `RenderRequest`. Raises InvalidRequest for a camera or
        options that are not valid.
        """
        return self._loop.run(self._async.render(camera, **options))

    def orbit(
        self,
        path: AnyPath,
        *,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
        keep: bool = True,
        **options: Unpack[OrbitArguments],
    ) -> Path:
        """Render a video (MP4) that circles the scene or follows a camera path, write it to `path`, and return that.

        `options` are the fields of `OrbitRequest`. `timeout` is the number of seconds to wait for the video; left out,
        as long as it takes. `on_progress` is called with the number of frames that are rendered.

        keep: keep the video with the model, where the same options find it again, and go on after a restart of the
        server. False renders it for this call alone, which a key with the scope `read` may do too; it is waited for as
        long as the server does by default.

        Raises InvalidRequest for options that are not valid. After the timeout it raises WaitTimeout, and the rendering
        continues; without `keep` it raises ConnectionFailed, and the rendering ends.
        """
        return self._loop.run_reporting(
            lambda report: self._async.orbit(path, timeout=timeout, on_progress=report, keep=keep, **options),
            on_progress,
        )

    def mesh(
        self,
        path: AnyPath,
        *,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
        **options: Unpack[MeshArguments],
    ) -> Path:
        """Make a mesh of the model: triangles with a colour at each vertex. Write it to `path`, and return that.

        `options` are the fields of `MeshRequest`; the format is that of the suffix of `path`, if it has one of them.
        `timeout` is the number of seconds to wait for the mesh; left out, as long as it takes. `on_progress` is called
        with what is being done. The server keeps the mesh with the model, where the same options find it again.

        Raises InvalidRequest for options that are not valid. After the timeout it raises WaitTimeout, and the server
        continues.
        """
        return self._loop.run_reporting(
            lambda report: self._async.mesh(path, timeout=timeout, on_progress=report, **options), on_progress
        )

    def edit(
        self,
        *,
        box: Box | Mapping[str, Sequence[float]] | None = None,
        min_opacity: float | None = None,
        max_size: float | None = None,
        selection: Selection | Mapping[str, Any] | None = None,
        name: str | None = None,
        preview: bool = False,
    ) -> Edited:
        """Make a new model of a part of this one, which is kept, and return what that does to the held-out photos.

        box: keep the Gaussians whose centre lies in it: `{"min": [x, y, z], "max": [x, y, z]}` in units of the model.
        min_opacity: keep the Gaussians of at least this opacity, between 0 and 1.
        max_size: keep the Gaussians whose standard deviation is at most this along every axis, in units of the model.
        selection: leave out the Gaussians in it, which was drawn on views of the model.
        name: of the new model; left out, that of this one.
        preview: only measure; no model is made.

        At least one of box, min_opacity, max_size and selection is needed. `model` of the returned record is the id of
        the new model, None for a preview. Raises InvalidRequest for values that are not valid, and for an edit that
        leaves nothing.
        """
        return self._loop.run(
            self._async.edit(
                box=box,
                min_opacity=min_opacity,
                max_size=max_size,
                selection=selection,
                name=name,
                preview=preview,
            )
        )


class JobHandle:
    """A job on the server."""

    def __init__(self, loop: BackgroundLoop, twin: AsyncJobHandle) -> None:
        self._loop = loop
        self._async = twin

    @property
    def job(self) -> Job:
        """The record of the job, as of the last request."""
        return self._async.job

    @property
    def refused(self) -> tuple[tuple[str, Problem], ...]:
        """Names of the photos that the server refused in the upload, each with the reason."""
        return self._async.refused

    @property
    def renamed(self) -> tuple[tuple[str, str], ...]:
        """Names of the files that are stored under other names, each with its name in the capture."""
        return self._async.renamed

    @property
    def id(self) -> str:
        """The id of the job and of its model."""
        return self._async.id

    @property
    def state(self) -> JobState:
        """The state, as of the last request."""
        return self._async.state

    def refresh(self) -> Job:
        """Request the current record of the job."""
        return self._loop.run(self._async.refresh())

    def rename(self, name: str | None) -> Job:
        """Name the job, and its model with it; None takes the name away. Returns the record."""
        return self._loop.run(self._async.rename(name))

    def label(self, *, tags: Sequence[str] | None = None, favourite: bool | None = None) -> Job:
        """Give the job, and its model with it, these tags in place of those it has, or a star. Returns the record.

        None leaves them as they are. Raises InvalidRequest for more than 12 tags, or ones over 40 characters.
        """
        return self._loop.run(self._async.label(tags=tags, favourite=favourite))

    def events(self, after: str | None = None) -> Iterator[EventRecord]:
        """Yield the events of the job until it ends. A lost connection is restored without losing events.

        `after` is the id of the last event already seen; without it, the events begin at the start of the job.
        """
        return self._loop.iterate(self._async.events(after))

    def wait(self, on_progress: OnProgress | None = None, *, timeout: float | None = None) -> ModelHandle:
        """Wait for the job to end and return its model. Raises JobFailed or JobCancelled when it ends without one.

        `on_progress` is called with each step of progress. `timeout` is the number of seconds to wait; left out, as
        long as the job takes. Raises WaitTimeout after the timeout, and the job continues.
        """
        return ModelHandle(
            self._loop,
            self._loop.run_reporting(lambda report: self._async.wait(report, timeout=timeout), on_progress),
        )

    def result(self) -> ModelHandle:
        """Return the model of a job that has ended. Raises JobFailed, JobCancelled, or Conflict while it runs."""
        return ModelHandle(self._loop, self._loop.run(self._async.result()))

    def cancel(self) -> Job:
        """Request the cancellation of the job. Its state becomes cancelled once its process has ended."""
        return self._loop.run(self._async.cancel())

    def restart(self) -> Job:
        """Run a job that has ended again, from its last checkpoint if there is one."""
        return self._loop.run(self._async.restart())

    def delete(self) -> None:
        """Delete the job, its model and its files."""
        self._loop.run(self._async.delete())

    def report(self) -> Report:
        """Return the report: error against run time, the plan, and where it ran."""
        return self._loop.run(self._async.report())

    def logs(self, *, limit: int = MOST_LINES) -> list[LogLine]:
        """Return the log of the job, oldest line first.

        `limit` is the largest number of lines; the last ones are returned.
        """
        return self._loop.run(self._async.logs(limit=limit))

    def curve(self) -> list[CurveRow]:
        """Return the error against run time that was measured so far, from the first measurement on."""
        return self._loop.run(self._async.curve())

    def preview(self) -> bytes:
        """Return the newest preview image (JPEG)."""
        return self._loop.run(self._async.preview())

    def cameras(self) -> Placement:
        """Return the cameras and points as structure from motion places them, and the photos that are not used."""
        return self._loop.run(self._async.cameras())

    def watch(self) -> float:
        """Ask the job for snapshots of its scene, and return for how many seconds it makes them without being asked.

        While it does, events announce the snapshots. A job that has ended makes none: 0.
        """
        return self._loop.run(self._async.watch())

    def snapshot(self) -> bytes:
        """Return the newest snapshot of the scene in training: a compressed .ply without spherical harmonics.

        Only a job that is watched makes snapshots. Raises NotFound while there is none.
        """
        return self._loop.run(self._async.snapshot())


class Client:
    """A client of a Splatmill server. Use it as a context manager, or call `close`.

    server: address of the server; by default SPLATMILL_SERVER, else that of the profile SPLATMILL_PROFILE, else the
        server on this machine.
    api_key: key of the server; by default SPLATMILL_API_KEY, or that of the profile.
    timeout: seconds to wait for a connection or for data.
    transport: httpx transport; an `httpx.ASGITransport` calls an app in this process without a socket.
    retries: how often a failed request is sent again, if that is safe.
    profile: name of a server in the file `config.toml`, in place of `server`.
    verify: file or folder of the certificates to trust, an `ssl.SSLContext`, or False, which checks no certificate; by
        default SPLATMILL_CA_BUNDLE, else the usual certificates.
    headers: headers to send with every request, such as those that a proxy before the server asks for.
    proxy: address of an HTTP proxy; by default that of the environment (HTTPS_PROXY).

    Raises ConfigurationInvalid for a profile or certificates that cannot be used.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout = TIMEOUT,
        transport: httpx.AsyncBaseTransport | None = None,
        retries: int = RETRIES,
        profile: str | None = None,
        verify: Verify | None = None,
        headers: Mapping[str, str] | None = None,
        proxy: str | None = None,
    ) -> None:
        self._async = AsyncClient(
            server,
            api_key=api_key,
            timeout=timeout,
            transport=transport,
            retries=retries,
            profile=profile,
            verify=verify,
            headers=headers,
            proxy=proxy,
        )
        self._loop = BackgroundLoop()
        self.keys = Keys(self._loop, self._async.keys)
        self.bin = Bin(self._loop, self._async.bin)
        self.webhooks = Webhooks(self._loop, self._async.webhooks)
        self.imports = Imports(self._loop, self._async.imports)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        if not self._loop.closed:
            self._loop.run(self._async.close())
            self._loop.close()

    @property
    def server(self) -> str:
        """The address of the server."""
        return self._async.server

    def train(
        self,
        path: AnyPath,
        *,
        name: str | None = None,
        on_progress: OnProgress | None = None,
        **options: Unpack[TrainArguments],
    ) -> JobHandle:
        """Upload the capture at `path` (photos, a zip archive, a video or a posed data set) and start a job on it.

        `options` are the fields of `TrainOptions`. `start` may also be the path of a model file on this machine, or its
        name in the folder `path`; the file is then uploaded with the poses. The options and the path are checked before
        anything is sent. The job continues when the connection is closed. Of the returned handle, `refused` lists the
        photos that the server refused, and `renamed` the files that it stores under other names. The same files are
        uploaded once: a second training uses the same capture.

        Raises NothingToUpload, ConnectionFailed, or a subclass of `Refused`.
        """
        return JobHandle(
            self._loop,
            self._loop.run_reporting(
                lambda report: self._async.train(path, name=name, on_progress=report, **options), on_progress
            ),
        )

    def upload(
        self,
        path: AnyPath,
        *,
        name: str | None = None,
        capture: str | None = None,
        on_progress: OnProgress | None = None,
        model: Path | None = None,
        resume: bool = False,
    ) -> tuple[Capture, Uploaded]:
        """Upload the capture at `path` into a new capture, or into the one with the id `capture`.

        With `resume`, the same files go into the same capture as before, and an upload that was interrupted is
        continued, also by another process. Files that are already stored are not sent again. `model` is the path of a
        model file to start from, which is uploaded with the poses.

        Raises NothingToUpload, ConnectionFailed, or a subclass of `Refused`.
        """
        return self._loop.run_reporting(
            lambda report: self._async.upload(
                path, name=name, capture=capture, on_progress=report, model=model, resume=resume
            ),
            on_progress,
        )

    def submit(
        self, capture: str, options: TrainOptions | None = None, *, name: str | None = None, priority: int = 0
    ) -> JobHandle:
        """Start a job on the stored capture with the id `capture`.

        Of the owner's jobs, those with a higher `priority` (-100 to 100) are run first.
        """
        return JobHandle(
            self._loop, self._loop.run(self._async.submit(capture, options, name=name, priority=priority))
        )

    def capture(self, capture_id: str) -> Capture:
        """Return a stored capture with its files."""
        return self._loop.run(self._async.capture(capture_id))

    def captures(
        self, *, limit: int | None = None, name: str | None = None, owner: str | None = None
    ) -> Iterator[Capture]:
        """Yield the captures without their files, newest first, at most `limit` of them.

        `name` chooses those whose name contains this text, in any case and accent. `owner` chooses those of one
        owner, for callers with the scope admin. Pages are requested as needed.
        """
        return self._loop.iterate(self._async.captures(limit=limit, name=name, owner=owner))

    def delete_capture(self, capture_id: str) -> None:
        """Delete a capture and its files. Raises Conflict while an unfinished job uses it."""
        self._loop.run(self._async.delete_capture(capture_id))

    def job(self, job_id: str) -> JobHandle:
        """Return the job with this id."""
        return JobHandle(self._loop, self._loop.run(self._async.job(job_id)))

    def jobs(
        self,
        *,
        limit: int | None = None,
        state: str | Iterable[str] | None = None,
        name: str | None = None,
        tag: str | None = None,
        favourite: bool | None = None,
        capture: str | None = None,
        sort: ListOrder | str = ListOrder.newest,
        owner: str | None = None,
    ) -> Iterator[Job]:
        """Yield the jobs, at most `limit` of them.

        `state` chooses those in this state, or one of several. `name` chooses those whose name contains this text, and
        `tag` those with this tag, in any case and accent; `favourite` those with a star, or without one; `capture`
        those on the capture with this id, and `owner` those of one owner, for callers with the scope admin. `sort` is
        what comes first: newest, name, or the size or psnr of the model; jobs without one come last. Pages are
        requested as needed.
        """
        return self._loop.iterate(
            self._async.jobs(
                limit=limit,
                state=state,
                name=name,
                tag=tag,
                favourite=favourite,
                capture=capture,
                sort=sort,
                owner=owner,
            )
        )

    def model(self, model_id: str) -> ModelHandle:
        """Return the finished model with this id, which is that of its job."""
        return ModelHandle(self._loop, self._loop.run(self._async.model(model_id)))

    def models(
        self,
        *,
        limit: int | None = None,
        name: str | None = None,
        tag: str | None = None,
        favourite: bool | None = None,
        sort: ListOrder | str = ListOrder.newest,
        owner: str | None = None,
    ) -> Iterator[Model]:
        """Yield the finished models, at most `limit` of them.

        `name` chooses those whose name contains this text, and `tag` those with this tag, in any case and accent;
        `favourite` those with a star, or without one. `sort` is what comes first: newest, name, size or psnr. `owner`
        chooses those of one owner, for callers with the scope admin. Pages are requested as needed.
        """
        return self._loop.iterate(
            self._async.models(limit=limit, name=name, tag=tag, favourite=favourite, sort=sort, owner=owner)
        )

    def options(self) -> list[OptionHelp]:
        """Return the training options of the server, with type, default, range and help."""
        return self._loop.run(self._async.options())

    def estimate(
        self,
        photos: int,
        options: TrainOptions | None = None,
        *,
        posed: bool = False,
        exact: bool = True,
        capture: str | None = None,
    ) -> Estimate:
        """Return how long a job on `photos` photos would take, derived from the jobs that the server has finished.

        `posed` states that the cameras come with the photos, and `exact` that their number is certain, as it is not for
        a video. `capture` is the id of the capture that holds them, whose cameras may be known. Nothing is created.
        Raises InvalidRequest for options that the server does not accept, and NotFound for a capture that it has not.
        """
        return self._loop.run(
            self._async.estimate(photos, options, posed=posed, exact=exact, capture=capture)
        )

    def me(self) -> Me:
        """Return who the server takes the caller for: owner, scopes, limits and their use."""
        return self._loop.run(self._async.me())

    def lan(self) -> LanAccess:
        """Return the address and the key by which devices of the local network use the server.

        It needs the scope admin. Raises NotFound where the server was not started by `splatmill up --lan`.
        """
        return self._loop.run(self._async.lan())

    def info(self) -> Info:
        """Return the version, the workers and the limits of the server."""
        return self._loop.run(self._async.info())

    def storage(self, *, owner: str | None = None, largest: int = 20) -> StorageUse:
        """Return what is in storage: the use of each owner that the key may see, and the `largest` records.

        `owner` restricts it to one owner, for admins.
        """
        return self._loop.run(self._async.storage(owner=owner, largest=largest))

    def ready(self) -> Ready:
        """Return whether the service can run jobs, with a check for each part."""
        return self._loop.run(self._async.ready())
