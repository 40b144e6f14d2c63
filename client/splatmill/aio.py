"""The asynchronous SDK: everything the service offers, on one event loop."""

import asyncio
import os
import tempfile
import time
import uuid
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, Self

import httpx
from pydantic import ValidationError

from splatmill.connection import RETRIES, TIMEOUT, Connection, pause, read_answer
from splatmill.downloads import OnBytes, download, target_of
from splatmill.errors import Conflict, ConnectionFailed, JobCancelled, JobFailed, Unavailable, invalid
from splatmill.layout import find_files
from splatmill.schema import (
    IDEMPOTENCY_HEADER,
    CameraSpec,
    Capture,
    EventRecord,
    Info,
    Job,
    JobPage,
    JobState,
    LogLine,
    LogPage,
    Model,
    ModelCamera,
    ModelCameras,
    ModelPage,
    OptionHelp,
    OptionList,
    OrbitRequest,
    Problem,
    Progress,
    ProgressEvent,
    Ready,
    RenderRequest,
    Report,
    TrainOptions,
)
from splatmill.sse import PATIENCE, follow
from splatmill.uploads import OnProgress, Uploaded, upload

AnyPath = str | os.PathLike[str]


class AsyncClient:
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
        self.connection = Connection(
            server, api_key=api_key, timeout=timeout, transport=transport, retries=retries
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self.connection.close()

    async def train(
        self, path: AnyPath, *, name: str | None = None, on_progress: OnProgress | None = None, **options: Any
    ) -> "AsyncJobHandle":
        """Upload what lies at `path` (photos, a zip, a video or a posed data set) and start a job on it.

        `options` are those of `TrainOptions`; they and the path are checked before anything is sent. The job goes
        on whatever becomes of this connection. `handle.refused` names photos the server would not take.
        """
        checked = train_options(options)
        capture, uploaded = await self.upload(path, name=name, on_progress=on_progress)
        handle = await self.submit(capture.id, checked, name=name)
        handle.refused = uploaded.refused
        return handle

    async def upload(
        self,
        path: AnyPath,
        *,
        name: str | None = None,
        capture: str | None = None,
        on_progress: OnProgress | None = None,
    ) -> tuple[Capture, Uploaded]:
        """Send what lies at `path` into a new capture, or into `capture` (files that are there are not sent twice)."""
        found = find_files(path)
        if capture is None:
            body = {"name": name or Path(path).expanduser().resolve().name}
            response = await self.connection.request("POST", "/v1/captures", json=body)
            target = read_answer(Capture, response)
        else:
            target = await self.capture(capture)
        return target, await upload(self.connection, target.id, found.files, on_progress)

    async def submit(
        self, capture: str, options: TrainOptions | None = None, *, name: str | None = None
    ) -> "AsyncJobHandle":
        """Start a job on a capture that is already stored."""
        chosen = options.model_dump(mode="json", exclude_unset=True) if options is not None else {}
        body = {"capture": capture, "name": name, "options": chosen}
        response = await self.connection.request(
            "POST",
            "/v1/jobs",
            json=body,
            # The same key on every try: an answer that got lost does not start a second job.
            headers={IDEMPOTENCY_HEADER: str(uuid.uuid4())},
            repeatable=True,
        )
        return AsyncJobHandle(self, read_answer(Job, response))

    async def capture(self, capture_id: str) -> Capture:
        """A stored capture with its files."""
        response = await self.connection.request("GET", f"/v1/captures/{capture_id}")
        return read_answer(Capture, response)

    async def job(self, job_id: str) -> "AsyncJobHandle":
        """A job by its id."""
        response = await self.connection.request("GET", f"/v1/jobs/{job_id}")
        return AsyncJobHandle(self, read_answer(Job, response))

    async def jobs(self, *, limit: int | None = None) -> AsyncIterator[Job]:
        """All jobs, newest first, page by page; `limit` at most."""
        cursor: str | None = None
        left = limit
        while left is None or left > 0:
            params = {"limit": min(left or 100, 100)} | ({"cursor": cursor} if cursor else {})
            response = await self.connection.request("GET", "/v1/jobs", params=params)
            page = read_answer(JobPage, response)
            for job in page.jobs[:left]:
                yield job
            left = None if left is None else left - len(page.jobs)
            cursor = page.cursor
            if cursor is None:
                return

    async def model(self, model_id: str) -> "AsyncModelHandle":
        """A finished model by its id, which is that of its job."""
        response = await self.connection.request("GET", f"/v1/models/{model_id}")
        return AsyncModelHandle(self, read_answer(Model, response))

    async def models(self) -> AsyncIterator[Model]:
        """All finished models, newest first."""
        cursor: str | None = None
        while True:
            params = {"cursor": cursor} if cursor else None
            response = await self.connection.request("GET", "/v1/models", params=params)
            page = read_answer(ModelPage, response)
            for model in page.models:
                yield model
            cursor = page.cursor
            if cursor is None:
                return

    async def options(self) -> list[OptionHelp]:
        """Every setting this server takes, with type, default, range and help."""
        response = await self.connection.request("GET", "/v1/options")
        return read_answer(OptionList, response).options

    async def info(self) -> Info:
        """What the server is, who works for it, and what it accepts."""
        response = await self.connection.request("GET", "/v1/info")
        return read_answer(Info, response)

    async def ready(self) -> Ready:
        """Whether the service can do its work, part by part."""
        try:
            response = await self.connection.http.get("/readyz")  # 503 is an answer here, not a failure
        except httpx.TransportError as error:
            raise self.connection.lost(error) from error
        return read_answer(Ready, response)


class AsyncJobHandle:
    """A job on the server. `job` is what was last heard of it."""

    def __init__(self, client: AsyncClient, job: Job) -> None:
        self.client = client
        self.job = job
        self.refused: tuple[tuple[str, Problem], ...] = ()

    @property
    def id(self) -> str:
        """The job's id, and its model's."""
        return self.job.id

    @property
    def state(self) -> JobState:
        """The state when last heard of."""
        return self.job.state

    async def refresh(self) -> Job:
        """Ask for the job's present state."""
        response = await self.client.connection.request("GET", f"/v1/jobs/{self.id}")
        self.job = read_answer(Job, response)
        return self.job

    async def events(self, after: str | None = None) -> AsyncIterator[EventRecord]:
        """What happens, as it happens, until the job's end; lost connections are taken up again.

        `after` is the id of an event to go on after; without it the stream begins at the job's beginning.
        """
        silent = 0
        while True:
            silent += 1
            async for record in follow(self.client.connection, f"/v1/jobs/{self.id}/events", after=after):
                after, silent = record.id, 0
                yield record
            if (await self._refresh_patiently()).state.final:
                return
            if silent:  # a server that ends its streams at once must not be asked in a tight circle
                await asyncio.sleep(pause(silent))

    async def _refresh_patiently(self) -> Job:
        """The job's present state, waiting out a service of which a part is down."""
        end = time.monotonic() + PATIENCE
        while True:
            try:
                return await self.refresh()
            except (Unavailable, ConnectionFailed):
                if time.monotonic() > end:
                    raise
                await asyncio.sleep(pause(self.client.connection.retries + 1))

    async def wait(self, on_progress: OnProgress | None = None) -> "AsyncModelHandle":
        """The model, once the job is done; raises JobFailed or JobCancelled when it ends without one."""
        async for record in self.events():
            if on_progress is not None and isinstance(record.event, ProgressEvent):
                on_progress(Progress.model_validate(record.event.model_dump(exclude={"type"})))
        return await self.result()

    async def result(self) -> "AsyncModelHandle":
        """The model of a job that has ended; raises JobFailed, JobCancelled, or Conflict while it runs."""
        job = await self.refresh()
        if job.state is JobState.succeeded:
            return await self.client.model(job.model or job.id)
        if job.state is JobState.cancelled:
            raise JobCancelled(job.id)
        if job.state is JobState.failed:
            problem = job.problem or Problem.of(
                "internal_error", f"The job {job.id} failed without a reason."
            )
            raise JobFailed(job.id, problem)
        detail = f"The job {job.id} is {job.state.value}; its model is not there yet."
        raise Conflict(Problem.of("model_not_ready", detail))

    async def cancel(self) -> Job:
        """Ask for the job's end; it is reported as cancelled once its process is gone."""
        return await self._post("cancel")

    async def restart(self) -> Job:
        """Run a job that has ended once more, going on from its last checkpoint where there is one."""
        return await self._post("restart")

    async def delete(self) -> None:
        """Remove the job, its model and its files."""
        await self.client.connection.request("DELETE", f"/v1/jobs/{self.id}")

    async def report(self) -> Report:
        """Error against run time, and what led to it."""
        response = await self.client.connection.request("GET", f"/v1/jobs/{self.id}/report")
        return read_answer(Report, response)

    async def logs(self) -> list[LogLine]:
        """The job's log, oldest line first."""
        response = await self.client.connection.request("GET", f"/v1/jobs/{self.id}/logs")
        return read_answer(LogPage, response).lines

    async def preview(self) -> bytes:
        """The newest preview picture (JPEG)."""
        response = await self.client.connection.request("GET", f"/v1/jobs/{self.id}/preview")
        return response.content

    async def _post(self, wish: str) -> Job:
        # Wishing twice is wishing once.
        response = await self.client.connection.request("POST", f"/v1/jobs/{self.id}/{wish}", repeatable=True)
        self.job = read_answer(Job, response)
        return self.job


class AsyncModelHandle:
    """A finished model on the server."""

    def __init__(self, client: AsyncClient, model: Model) -> None:
        self.client = client
        self.model = model

    @property
    def id(self) -> str:
        """The model's id."""
        return self.model.id

    async def download(
        self, path: AnyPath, *, file: str = "model.ply", on_bytes: OnBytes | None = None
    ) -> Path:
        """Write one of the model's files to `path` (a file, or a folder that exists), whole or not at all."""
        digest = next((entry.sha256 for entry in self.model.files if entry.name == file), None)
        return await download(
            self.client.connection,
            f"/v1/models/{self.id}/files/{file}",
            target_of(path, file),
            sha256=digest,
            on_bytes=on_bytes,
        )

    async def cameras(self) -> list[ModelCamera]:
        """The cameras of the capture in the model's world, held-out ones marked `test`."""
        response = await self.client.connection.request("GET", f"/v1/models/{self.id}/cameras")
        return read_answer(ModelCameras, response).cameras

    async def render(self, camera: CameraSpec | Mapping[str, Any], **wishes: Any) -> bytes:
        """The picture from `camera`; `wishes` are `output`, `format`, `background` and `quality` of RenderRequest."""
        try:
            request = RenderRequest.model_validate({"camera": camera} | wishes)
        except ValidationError as error:
            raise invalid(error, "camera_invalid") from error
        response = await self.client.connection.request(
            "POST",
            f"/v1/models/{self.id}/render",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            timeout=RENDER_TIMEOUT,
        )
        return response.content

    async def orbit(self, path: AnyPath, **wishes: Any) -> Path:
        """Write a video (MP4) that circles the scene to `path`; `wishes` are the fields of OrbitRequest."""
        try:
            request = OrbitRequest.model_validate(wishes)
        except ValidationError as error:
            raise invalid(error) from error
        response = await self.client.connection.request(
            "POST",
            f"/v1/models/{self.id}/orbit",
            json=request.model_dump(mode="json", exclude_none=True),
            repeatable=True,
            timeout=ORBIT_TIMEOUT,
        )
        return write_whole(target_of(path, "orbit.mp4"), response.content)


# A little longer than the server waits for its renderer, so that its sentence arrives instead of ours.
RENDER_TIMEOUT = httpx.Timeout(30.0, read=150.0)
# Hundreds of frames on a machine without a GPU take minutes, and the answer begins when the video is whole.
ORBIT_TIMEOUT = httpx.Timeout(30.0, read=900.0)


def train_options(options: Mapping[str, Any]) -> TrainOptions:
    """The options a person gave, checked; raises InvalidRequest with one clause per value that does not fit."""
    try:
        return TrainOptions.model_validate(dict(options))
    except ValidationError as error:
        unknown = any(entry["type"] == "extra_forbidden" for entry in error.errors())
        raise invalid(error, "unknown_option" if unknown else "option_out_of_range") from error


def write_whole(target: Path, data: bytes) -> Path:
    """Write `data` to `target`, which appears whole or not at all."""
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=target.name, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as sink:
            sink.write(data)
        Path(name).chmod(0o644)
        Path(name).replace(target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return target
