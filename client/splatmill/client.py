"""The synchronous SDK: the asynchronous one, waited for. `aio`, `job` and `model` say what each call does."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import httpx

from splatmill.aio import AsyncClient
from splatmill.connection import RETRIES, TIMEOUT
from splatmill.downloads import AnyPath, OnBytes
from splatmill.job import AsyncJobHandle
from splatmill.loop import BackgroundLoop
from splatmill.model import AsyncModelHandle
from splatmill.schema import (
    CameraSpec,
    Capture,
    EventRecord,
    Info,
    Job,
    JobState,
    LogLine,
    Model,
    ModelCamera,
    OptionHelp,
    Problem,
    Ready,
    Report,
    TrainOptions,
)
from splatmill.uploads import OnProgress, Uploaded


class Client:
    """A Splatmill server.

    `server` is its address (default: SPLATMILL_SERVER, then the local one), `api_key` its key (default:
    SPLATMILL_API_KEY), `transport` what carries the requests (an `httpx.ASGITransport` needs no socket).
    Use it as a context manager, or call `close`.
    """

    def __init__(
        self,
        server: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout = TIMEOUT,
        transport: httpx.AsyncBaseTransport | None = None,
        retries: int = RETRIES,
    ) -> None:
        self._async = AsyncClient(
            server, api_key=api_key, timeout=timeout, transport=transport, retries=retries
        )
        self._loop = BackgroundLoop()

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
        """The server's address."""
        return self._async.connection.server

    def train(
        self, path: AnyPath, *, name: str | None = None, on_progress: OnProgress | None = None, **options: Any
    ) -> "JobHandle":
        """Upload photos, a zip, a video or a posed data set, and start a job on it."""
        handle = self._loop.run_reporting(
            lambda report: self._async.train(path, name=name, on_progress=report, **options), on_progress
        )
        return JobHandle(self._loop, handle)

    def upload(
        self,
        path: AnyPath,
        *,
        name: str | None = None,
        capture: str | None = None,
        on_progress: OnProgress | None = None,
        model: Path | None = None,
    ) -> tuple[Capture, Uploaded]:
        """Send what lies at `path` into a new capture, or into `capture`, and `model`, a .ply to start from."""
        return self._loop.run_reporting(
            lambda report: self._async.upload(
                path, name=name, capture=capture, on_progress=report, model=model
            ),
            on_progress,
        )

    def submit(
        self, capture: str, options: TrainOptions | None = None, *, name: str | None = None
    ) -> "JobHandle":
        """Start a job on a capture that is already stored."""
        return JobHandle(self._loop, self._loop.run(self._async.submit(capture, options, name=name)))

    def capture(self, capture_id: str) -> Capture:
        """A stored capture with its files."""
        return self._loop.run(self._async.capture(capture_id))

    def job(self, job_id: str) -> "JobHandle":
        """A job by its id."""
        return JobHandle(self._loop, self._loop.run(self._async.job(job_id)))

    def jobs(self, *, limit: int | None = None) -> Iterator[Job]:
        """All jobs, newest first; `limit` at most."""
        return self._loop.iterate(self._async.jobs(limit=limit))

    def model(self, model_id: str) -> "ModelHandle":
        """A finished model by its id, which is that of its job."""
        return ModelHandle(self._loop, self._loop.run(self._async.model(model_id)))

    def models(self) -> Iterator[Model]:
        """All finished models, newest first."""
        return self._loop.iterate(self._async.models())

    def options(self) -> list[OptionHelp]:
        """Every setting this server takes, with type, default, range and help."""
        return self._loop.run(self._async.options())

    def info(self) -> Info:
        """What the server is, who works for it, and what it accepts."""
        return self._loop.run(self._async.info())

    def ready(self) -> Ready:
        """Whether the service can do its work, part by part."""
        return self._loop.run(self._async.ready())


class JobHandle:
    """A job on the server. `job` is what was last heard of it."""

    def __init__(self, loop: BackgroundLoop, handle: AsyncJobHandle) -> None:
        self._loop = loop
        self._async = handle

    @property
    def id(self) -> str:
        """The job's id, and its model's."""
        return self._async.id

    @property
    def job(self) -> Job:
        """The job when last heard of."""
        return self._async.job

    @property
    def state(self) -> JobState:
        """The state when last heard of."""
        return self._async.state

    @property
    def refused(self) -> tuple[tuple[str, Problem], ...]:
        """Photos the server would not take, with its reasons."""
        return self._async.refused

    def refresh(self) -> Job:
        """Ask for the job's present state."""
        return self._loop.run(self._async.refresh())

    def events(self, after: str | None = None) -> Iterator[EventRecord]:
        """What happens, as it happens, until the job's end; lost connections are taken up again."""
        return self._loop.iterate(self._async.events(after))

    def wait(self, on_progress: OnProgress | None = None) -> "ModelHandle":
        """The model, once the job is done; raises JobFailed or JobCancelled when it ends without one."""
        return ModelHandle(self._loop, self._loop.run_reporting(self._async.wait, on_progress))

    def result(self) -> "ModelHandle":
        """The model of a job that has ended; raises JobFailed, JobCancelled, or Conflict while it runs."""
        return ModelHandle(self._loop, self._loop.run(self._async.result()))

    def cancel(self) -> Job:
        """Ask for the job's end; it is reported as cancelled once its process is gone."""
        return self._loop.run(self._async.cancel())

    def restart(self) -> Job:
        """Run a job that has ended once more, going on from its last checkpoint where there is one."""
        return self._loop.run(self._async.restart())

    def delete(self) -> None:
        """Remove the job, its model and its files."""
        self._loop.run(self._async.delete())

    def report(self) -> Report:
        """Error against run time, and what led to it."""
        return self._loop.run(self._async.report())

    def logs(self) -> list[LogLine]:
        """The job's log, oldest line first."""
        return self._loop.run(self._async.logs())

    def preview(self) -> bytes:
        """The newest preview picture (JPEG)."""
        return self._loop.run(self._async.preview())


class ModelHandle:
    """A finished model on the server."""

    def __init__(self, loop: BackgroundLoop, handle: AsyncModelHandle) -> None:
        self._loop = loop
        self._async = handle

    @property
    def id(self) -> str:
        """The model's id."""
        return self._async.id

    @property
    def model(self) -> Model:
        """The model's record."""
        return self._async.model

    def download(self, path: AnyPath, *, file: str = "model.ply", on_bytes: OnBytes | None = None) -> Path:
        """Write one of the model's files to `path` (a file, or a folder that exists), whole or not at all."""
        return self._loop.run(self._async.download(path, file=file, on_bytes=on_bytes))

    def cameras(self) -> list[ModelCamera]:
        """The cameras of the capture in the model's world, held-out ones marked `test`."""
        return self._loop.run(self._async.cameras())

    def render(self, camera: CameraSpec | Mapping[str, Any], **wishes: Any) -> bytes:
        """The picture from `camera`; `wishes` are `output`, `format`, `background` and `quality` of RenderRequest."""
        return self._loop.run(self._async.render(camera, **wishes))

    def orbit(self, path: AnyPath, **wishes: Any) -> Path:
        """Write a video (MP4) that circles the scene to `path`; `wishes` are the fields of OrbitRequest."""
        return self._loop.run(self._async.orbit(path, **wishes))
