"""The asynchronous SDK: everything the service offers, on one event loop."""

import uuid
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, Self

import httpx
from pydantic import ValidationError

from splatmill.connection import RETRIES, TIMEOUT, Connection, read_answer
from splatmill.downloads import AnyPath
from splatmill.errors import invalid
from splatmill.job import AsyncJobHandle
from splatmill.layout import find_files, start_file
from splatmill.model import AsyncModelHandle, find_model
from splatmill.schema import (
    IDEMPOTENCY_HEADER,
    Capture,
    Info,
    Job,
    JobPage,
    Model,
    ModelPage,
    OptionHelp,
    OptionList,
    Ready,
    TrainOptions,
)
from splatmill.uploads import OnProgress, Uploaded, upload


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
    ) -> AsyncJobHandle:
        """Upload what lies at `path` (photos, a zip, a video or a posed data set) and start a job on it.

        `options` are those of `TrainOptions`; they and the path are checked before anything is sent. `start` may
        also be the path of a .ply file here, or its name in the folder at `path`; it is uploaded beside the poses.
        The job goes on whatever becomes of this connection. `handle.refused` names photos the server would not take.
        """
        options, model = with_start_file(options, path)
        checked = train_options(options)
        capture, uploaded = await self.upload(path, name=name, on_progress=on_progress, model=model)
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
        model: Path | None = None,
    ) -> tuple[Capture, Uploaded]:
        """Send what lies at `path` into a new capture, or into `capture` (files that are there are not sent twice).

        `model`: a .ply to start from, to be sent along.
        """
        files = [*find_files(path).files, *([start_file(model)] if model is not None else [])]
        if capture is None:
            body = {"name": name or Path(path).expanduser().resolve().name}
            response = await self.connection.request("POST", "/v1/captures", json=body)
            target = read_answer(Capture, response)
        else:
            target = await self.capture(capture)
        return target, await upload(self.connection, target.id, files, on_progress)

    async def submit(
        self, capture: str, options: TrainOptions | None = None, *, name: str | None = None
    ) -> AsyncJobHandle:
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
        return AsyncJobHandle(self.connection, read_answer(Job, response))

    async def capture(self, capture_id: str) -> Capture:
        """A stored capture with its files."""
        response = await self.connection.request("GET", f"/v1/captures/{capture_id}")
        return read_answer(Capture, response)

    async def job(self, job_id: str) -> AsyncJobHandle:
        """A job by its id."""
        response = await self.connection.request("GET", f"/v1/jobs/{job_id}")
        return AsyncJobHandle(self.connection, read_answer(Job, response))

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

    async def model(self, model_id: str) -> AsyncModelHandle:
        """A finished model by its id, which is that of its job."""
        return await find_model(self.connection, model_id)

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


def with_start_file(options: Mapping[str, Any], folder: AnyPath) -> tuple[dict[str, Any], Path | None]:
    """The options with a local .ply in `start` replaced by its name in the capture, and its path, if it is one.

    A .ply that is not there is looked for in `folder`, the data set. Raises NothingToUpload for one that is in neither.
    """
    start = options.get("start")
    if start is None or not str(start).lower().endswith(".ply"):
        return dict(options), None
    path = Path(start).expanduser()
    inside = Path(folder).expanduser() / path
    if not path.is_file() and inside.is_file():
        path = inside
    return {**options, "start": start_file(path).name}, path


def train_options(options: Mapping[str, Any]) -> TrainOptions:
    """The options a person gave, checked; raises InvalidRequest with one clause per value that does not fit."""
    try:
        return TrainOptions.model_validate(dict(options))
    except ValidationError as error:
        unknown = any(entry["type"] == "extra_forbidden" for entry in error.errors())
        raise invalid(error, "unknown_option" if unknown else "option_out_of_range") from error
