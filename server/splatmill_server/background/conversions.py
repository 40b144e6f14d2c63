"""Models in other file formats: made by the renderer when somebody asks, then kept in storage beside the model."""

import asyncio
import json
from dataclasses import dataclass

import httpx
from pydantic import ValidationError
from redis import Redis
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import rendering
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Entry, Storage
from splatmill.schema import (
    CONVERSION_HEADER,
    CONVERSION_VERSION,
    DEFAULT_OWNER,
    DOWNLOADS,
    PROBLEMS,
    Conversion,
    ConversionRequest,
    ModelDownload,
    ModelDownloads,
    ModelFormat,
    Problem,
)
from splatmill_server.access.caller import Caller
from splatmill_server.base.leases import lease
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.renderer import post
from splatmill_server.base.root_path import address
from splatmill_server.models import Models, model_not_found
from splatmill_server.space.quota import RECORD_BYTES, Arrival, Quota

STORED_AS_IT_IS = "ply"
"""Key of the format of model.ply, which needs no conversion."""

POLL_SECONDS = 0.5
"""Time between two checks of a conversion that another API process makes."""


@dataclass
class _Running:
    """A conversion in progress, and the number of requests that wait for it."""

    task: asyncio.Task[None]
    waiting: int = 0


class Conversions:
    """The formats of all models. Requests for one that is being made wait for the same conversion, in all processes.

    seconds: how long the renderer may take.
    """

    def __init__(
        self,
        storage: Storage,
        connection: Redis,
        models: Models,
        renderer: httpx.AsyncClient | None,
        quota: Quota,
        seconds: float,
    ) -> None:
        self._storage = storage
        self._redis = connection
        self._models = models
        self._renderer = renderer
        self._quota = quota
        self._seconds = seconds
        self._running: dict[tuple[str, str], _Running] = {}

    def list(self, model_id: str) -> ModelDownloads:
        """Return the formats of a model with what is known of each. Raises 404 and 409 problems."""
        model = self._models.get(model_id)
        etag = self._ply(model_id).etag
        formats = []
        for key, form in DOWNLOADS.items():
            conversion = None if key == STORED_AS_IT_IS else self._find(model_id, form, etag)
            formats.append(
                ModelDownload(
                    format=key,
                    name=form.name,
                    media_type=form.media_type,
                    loses=form.loses,
                    readers=[*form.readers],
                    address=address(f"/v1/models/{model_id}/download/{key}"),
                    bytes=model.bytes
                    if key == STORED_AS_IT_IS
                    else conversion[0].size
                    if conversion
                    else None,
                    conversion=conversion[1] if conversion else None,
                )
            )
        return ModelDownloads(formats=formats, psnr=model.psnr)

    async def get_path(self, model_id: str, form: ModelFormat, who: Caller | None = None) -> str:
        """Return the path of the model in a format, which is made if it is not there.

        who: the caller; None for somebody with a link.

        The conversion is given up when nobody waits for it any more. Raises 404, 409 and 5xx problems.
        """
        if form.key == STORED_AS_IT_IS:
            return (await run_in_threadpool(self._ply, model_id)).path
        if not await self._stored(model_id, form):
            if who is not None:
                await run_in_threadpool(self._quota.note, who)
            await self._made(model_id, form)
        return layout.conversion(model_id, form.key)

    async def _made(self, model_id: str, form: ModelFormat) -> None:
        """Wait for the conversion, which the first request starts."""
        key = (model_id, form.key)
        running = self._running.get(key)
        if running is None:
            running = self._running[key] = _Running(asyncio.create_task(self._make_once(model_id, form)))
            running.task.add_done_callback(lambda _: self._forget(key, running))
        running.waiting += 1
        try:
            await asyncio.shield(running.task)
        finally:
            running.waiting -= 1
            if not running.waiting and not running.task.done():
                self._forget(key, running)
                running.task.cancel()

    def _forget(self, key: tuple[str, str], running: _Running | None) -> None:
        if self._running.get(key) is running:
            del self._running[key]

    async def _make_once(self, model_id: str, form: ModelFormat) -> None:
        """Convert, or wait until another process has."""
        while True:
            async with lease(self._redis, "conversion", f"{model_id}.{form.key}") as mine:
                if mine:
                    if not await self._stored(model_id, form):
                        await self._make(model_id, form)
                    return
            await asyncio.sleep(POLL_SECONDS)

    async def _make(self, model_id: str, form: ModelFormat) -> None:
        owner = await run_in_threadpool(self._models.get_owner, model_id) or DEFAULT_OWNER
        async with self._quota.storing(None, owner, model_id, RECORD_BYTES) as room:
            await self._convert(model_id, form, owner, room)

    async def _convert(self, model_id: str, form: ModelFormat, owner: str, room: Arrival) -> None:
        content = ConversionRequest(format=form.key).model_dump_json()
        # Whoever asks, the conversion is for everybody who may read the model, and counts for its owner.
        headers = {rendering.CLIENT_HEADER: rendering.client_of(owner, "conversions")}
        answer = await post(self._renderer, rendering.convert_path(model_id), content, headers, self._seconds)
        try:
            if answer.status_code != 200:
                raise _refused(await answer.aread())
            record = Conversion.model_validate_json(answer.headers.get(CONVERSION_HEADER, ""))
            await run_in_threadpool(room.take, len(record.model_dump_json().encode()))
            await run_in_threadpool(room.announce, answer.headers.get("content-length"))
            await self._storage.stream_put(
                layout.conversion(model_id, form.key), room.counted(answer.aiter_raw())
            )
        except httpx.TransportError as error:
            raise ProblemError(
                "renderer_unavailable",
                f"The renderer ended while it sent the conversion ({type(error).__name__}).",
                advice="Nothing was stored. Try again in a few seconds.",
                headers={"Retry-After": "5"},
            ) from error
        except ValidationError as error:
            raise ProblemError(
                "conversion_failed",
                "The renderer answered without a record of the conversion.",
                advice="Try again. If the problem persists, read the log of the renderer.",
            ) from error
        finally:
            await answer.aclose()
        await run_in_threadpool(self._record, model_id, form, record)

    def _record(self, model_id: str, form: ModelFormat, record: Conversion) -> None:
        """Store the record, unless the model was deleted meanwhile."""
        if self._storage.exists(layout.job_record(model_id)):
            self._storage.put(layout.conversion_record(model_id, form.key), record.model_dump_json().encode())
        if not self._storage.exists(layout.job_record(model_id)):
            self._storage.delete(layout.conversion_record(model_id, form.key))
            self._storage.delete(layout.conversion(model_id, form.key))
            raise model_not_found(model_id)

    async def _stored(self, model_id: str, form: ModelFormat) -> bool:
        def look() -> bool:
            return self._find(model_id, form, self._ply(model_id).etag) is not None

        return await run_in_threadpool(look)

    def _find(self, model_id: str, form: ModelFormat, etag: str) -> tuple[Entry, Conversion] | None:
        """The converted file and its record, if it was made of the present model by the present converters."""
        try:
            text = self._storage.get(layout.conversion_record(model_id, form.key))
            record = Conversion.model_validate_json(text)
        except (FileNotFoundError, ValidationError):
            return None
        entry = self._storage.head(layout.conversion(model_id, form.key))
        fits = record.model == etag and record.version == CONVERSION_VERSION
        return (entry, record) if entry is not None and fits else None

    def _ply(self, model_id: str) -> Entry:
        return self._models.get_file(model_id, "model.ply")


def format_of_key(key: str) -> ModelFormat:
    """Return the format with this key. Raises a 404 problem."""
    form = DOWNLOADS.get(key)
    if form is None:
        raise ProblemError(
            "format_unknown",
            f"There is no format {key[:40]!r}.",
            advice=f"Those that are: {', '.join(DOWNLOADS)}.",
            facts={"formats": [*DOWNLOADS]},
        )
    return form


def _refused(body: bytes) -> ProblemError:
    """The problem that the renderer answered with."""
    try:
        problem = Problem.model_validate(json.loads(body))
    except (ValueError, ValidationError):
        return ProblemError("conversion_failed", "The renderer answered without a problem document.")
    code = (
        "conversion_failed"
        if problem.code == "render_failed" or problem.code not in PROBLEMS
        else problem.code
    )
    return ProblemError(code, problem.detail, advice=problem.advice, facts=problem.facts)
