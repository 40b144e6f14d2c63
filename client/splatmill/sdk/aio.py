"""The asynchronous SDK: `AsyncClient`."""

import uuid
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, TypeVar, Unpack

import httpx

from splatmill.schema import (
    IDEMPOTENCY_HEADER,
    Capture,
    CapturePage,
    Estimate,
    Info,
    Job,
    JobPage,
    LanAccess,
    ListOrder,
    Me,
    Model,
    ModelPage,
    OptionHelp,
    OptionList,
    Problem,
    Ready,
    StorageUse,
    TrainOptions,
)
from splatmill.sdk.arguments import TrainArguments
from splatmill.sdk.bin import AsyncBin
from splatmill.sdk.imports import AsyncImports
from splatmill.sdk.job import AsyncJobHandle
from splatmill.sdk.keys import AsyncKeys
from splatmill.sdk.model import AsyncModelHandle, find_model
from splatmill.sdk.webhooks import AsyncWebhooks
from splatmill.transfer.connection import RETRIES, TIMEOUT, Connection, read_answer
from splatmill.transfer.downloads import AnyPath
from splatmill.transfer.local_capture import find_files, printable, start_model
from splatmill.transfer.server_choice import Verify
from splatmill.transfer.training_options import train_options, with_start_model
from splatmill.transfer.uploads import OnProgress, Uploaded, key_of, upload

PAGE = 100
"""Largest number of entries that are requested at once of a list."""

P = TypeVar("P", CapturePage, JobPage, ModelPage)
T = TypeVar("T")


class AsyncClient:
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
        self.connection = Connection(
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
        self.keys = AsyncKeys(self.connection)
        self.bin = AsyncBin(self.connection)
        self.webhooks = AsyncWebhooks(self.connection)
        self.imports = AsyncImports(self.connection)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self.connection.close()

    @property
    def server(self) -> str:
        """The address of the server."""
        return self.connection.server

    async def train(
        self,
        path: AnyPath,
        *,
        name: str | None = None,
        on_progress: OnProgress | None = None,
        **options: Unpack[TrainArguments],
    ) -> AsyncJobHandle:
        """Upload the capture at `path` (photos, a zip archive, a video or a posed data set) and start a job on it.

        `options` are the fields of `TrainOptions`. `start` may also be the path of a model file on this machine, or its
        name in the folder `path`; the file is then uploaded with the poses. The options and the path are checked before
        anything is sent. The job continues when the connection is closed. Of the returned handle, `refused` lists the
        photos that the server refused, and `renamed` the files that it stores under other names. The same files are
        uploaded once: a second training uses the same capture.

        Raises NothingToUpload, ConnectionFailed, or a subclass of `Refused`.
        """
        arguments, model = with_start_model(options, path)
        checked = train_options(arguments)
        capture, uploaded = await self.upload(
            path, name=name, on_progress=on_progress, model=model, resume=True
        )
        handle = await self.submit(capture.id, checked, name=name)
        handle.refused, handle.renamed = uploaded.refused, uploaded.renamed
        return handle

    async def upload(
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
        capture_files = find_files(path)
        files = [*capture_files.files, *([start_model(model)] if model is not None else [])]
        if capture is None:
            body = {"name": name or printable(Path(path).expanduser().resolve().name)}
            if resume:
                body["key"] = await key_of(files)
            response = await self.connection.request("POST", "/v1/captures", json=body, repeatable=resume)
            target = read_answer(Capture, response)
        else:
            target = await self.capture(capture)
        uploaded = await upload(self.connection, target.id, files, on_progress, stored_files=target.files)
        unnamed = tuple((name, Problem.of("name_invalid", why)) for name, why in capture_files.left_out)
        return target, replace(uploaded, refused=(*unnamed, *uploaded.refused), renamed=capture_files.renamed)

    async def submit(
        self,
        capture: str,
        options: TrainOptions | None = None,
        *,
        name: str | None = None,
        priority: int = 0,
    ) -> AsyncJobHandle:
        """Start a job on the stored capture with the id `capture`.

        Of the owner's jobs, those with a higher `priority` (-100 to 100) are run first.
        """
        chosen = options.model_dump(mode="json", exclude_unset=True) if options is not None else {}
        body: dict[str, Any] = {"capture": capture, "name": name, "options": chosen}
        if priority:
            body["priority"] = priority
        response = await self.connection.request(
            "POST",
            "/v1/jobs",
            json=body,
            # Every attempt carries the same key, so that a lost response does not lead to a second job.
            headers={IDEMPOTENCY_HEADER: str(uuid.uuid4())},
            repeatable=True,
        )
        return AsyncJobHandle(self.connection, read_answer(Job, response))

    async def capture(self, capture_id: str) -> Capture:
        """Return a stored capture with its files."""
        response = await self.connection.request("GET", f"/v1/captures/{capture_id}")
        return read_answer(Capture, response)

    def captures(
        self, *, limit: int | None = None, name: str | None = None, owner: str | None = None
    ) -> AsyncIterator[Capture]:
        """Yield the captures without their files, newest first, at most `limit` of them.

        `name` chooses those whose name contains this text, in any case and accent. `owner` chooses those of one
        owner, for callers with the scope admin. Pages are requested as needed.
        """
        return self._entries(
            CapturePage, "/v1/captures", lambda page: page.captures, limit, {"name": name, "owner": owner}
        )

    async def delete_capture(self, capture_id: str) -> None:
        """Delete a capture and its files. Raises Conflict while an unfinished job uses it."""
        await self.connection.request("DELETE", f"/v1/captures/{capture_id}")

    async def job(self, job_id: str) -> AsyncJobHandle:
        """Return the job with this id."""
        response = await self.connection.request("GET", f"/v1/jobs/{job_id}")
        return AsyncJobHandle(self.connection, read_answer(Job, response))

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
    ) -> AsyncIterator[Job]:
        """Yield the jobs, at most `limit` of them.

        `state` chooses those in this state, or one of several. `name` chooses those whose name contains this text, and
        `tag` those with this tag, in any case and accent; `favourite` those with a star, or without one; `capture`
        those on the capture with this id, and `owner` those of one owner, for callers with the scope admin. `sort` is
        what comes first: newest, name, or the size or psnr of the model; jobs without one come last. Pages are
        requested as needed.
        """
        states = [state] if isinstance(state, str) else list(state or ())
        filters = {
            "state": states or None,
            "name": name,
            "tag": tag,
            "favourite": favourite,
            "capture": capture,
            "sort": str(sort),
            "owner": owner,
        }
        return self._entries(JobPage, "/v1/jobs", lambda page: page.jobs, limit, filters)

    async def model(self, model_id: str) -> AsyncModelHandle:
        """Return the finished model with this id, which is that of its job."""
        return await find_model(self.connection, model_id)

    def models(
        self,
        *,
        limit: int | None = None,
        name: str | None = None,
        tag: str | None = None,
        favourite: bool | None = None,
        sort: ListOrder | str = ListOrder.newest,
        owner: str | None = None,
    ) -> AsyncIterator[Model]:
        """Yield the finished models, at most `limit` of them.

        `name` chooses those whose name contains this text, and `tag` those with this tag, in any case and accent;
        `favourite` those with a star, or without one. `sort` is what comes first: newest, name, size or psnr. `owner`
        chooses those of one owner, for callers with the scope admin. Pages are requested as needed.
        """
        filters = {"name": name, "tag": tag, "favourite": favourite, "sort": str(sort), "owner": owner}
        return self._entries(ModelPage, "/v1/models", lambda page: page.models, limit, filters)

    async def options(self) -> list[OptionHelp]:
        """Return the training options of the server, with type, default, range and help."""
        response = await self.connection.request("GET", "/v1/options")
        return read_answer(OptionList, response).options

    async def estimate(
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
        chosen = options.model_dump(mode="json", exclude_unset=True) if options is not None else {}
        body: dict[str, Any] = {"photos": photos, "posed": posed, "options": chosen}
        if not exact:
            body["exact"] = False
        if capture is not None:
            body["capture"] = capture
        response = await self.connection.request("POST", "/v1/estimate", json=body, repeatable=True)
        return read_answer(Estimate, response)

    async def me(self) -> Me:
        """Return who the server takes the caller for: owner, scopes, limits and their use."""
        return read_answer(Me, await self.connection.request("GET", "/v1/me"))

    async def lan(self) -> LanAccess:
        """Return the address and the key by which devices of the local network use the server.

        It needs the scope admin. Raises NotFound where the server was not started by `splatmill up --lan`.
        """
        return read_answer(LanAccess, await self.connection.request("GET", "/v1/lan"))

    async def info(self) -> Info:
        """Return the version, the workers and the limits of the server."""
        response = await self.connection.request("GET", "/v1/info")
        return read_answer(Info, response)

    async def storage(self, *, owner: str | None = None, largest: int = 20) -> StorageUse:
        """Return what is in storage: the use of each owner that the key may see, and the `largest` records.

        `owner` restricts it to one owner, for admins.
        """
        params = {"largest": largest} | ({"owner": owner} if owner is not None else {})
        response = await self.connection.request("GET", "/v1/storage", params=params)
        return read_answer(StorageUse, response)

    async def ready(self) -> Ready:
        """Return whether the service can run jobs, with a check for each part."""
        try:
            response = await self.connection.http.get(
                "/readyz"
            )  # here, a response with status 503 is a valid answer
        except httpx.TransportError as error:
            raise self.connection.lost(error) from error
        return read_answer(Ready, response)

    async def _entries(
        self,
        kind: type[P],
        path: str,
        entries: Callable[[P], list[T]],
        limit: int | None,
        filters: Mapping[str, Any],
    ) -> AsyncIterator[T]:
        """Yield at most `limit` entries of the list at `path`, which comes in pages of the type `kind`."""
        cursor: str | None = None
        left = limit
        while left is None or left > 0:
            size = PAGE if left is None else min(left, PAGE)
            params = {"limit": size, "cursor": cursor, **filters}
            query = {key: value for key, value in params.items() if value is not None}
            page = read_answer(kind, await self.connection.request("GET", path, params=query))
            for entry in entries(page)[:left]:
                yield entry
            left = None if left is None else left - len(entries(page))
            cursor = page.cursor
            if cursor is None:
                return
