"""Imports: the server fetches files of a capture from addresses that users give.

An import is a record in storage and a mark that it has not ended, so it survives a restart: any API process takes up
marked imports, under a lease in Redis. A file is always fetched from its beginning, and stored as an upload is.

Owners take turns. An import fails if the other server does not answer or sends too slowly, holds up no other import
between two attempts, and ends with its capture.
"""

import asyncio
import json
import secrets
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from urllib.parse import unquote

import httpx
import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, UnreadableRecord, read_record
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import (
    DEFAULT_OWNER,
    CreateImport,
    Import,
    ImportState,
    Problem,
    UnsafeName,
    safe_name,
)
from splatmill_server.base.leases import exclusive
from splatmill_server.base.least_rate import TooSlow, at_least
from splatmill_server.base.outgoing import AddressRefused, Answer, NoAnswer, Outgoing
from splatmill_server.base.problems import ProblemError, problem_of_storage
from splatmill_server.base.settings import Settings
from splatmill_server.base.turns import Turns
from splatmill_server.base.unfinished import Unfinished
from splatmill_server.captures.records import Captures
from splatmill_server.space.quota import Quota, bytes_beside

log = structlog.get_logger()

MAX_REDIRECTS = 5
MAX_ATTEMPTS = 4
MAX_UNFINISHED = 100
"""Imports of one capture that may be unfinished at once."""

MAX_OF_OWNER = 500
"""Imports of one owner that may be unfinished at once."""

_CONCURRENT = 8
_CONCURRENT_EACH = 3
"""Imports that one API process runs at once, in all and of one owner. Each holds some blocks of its file in memory."""

_ANSWER_SECONDS = 60.0
"""Seconds until the other server must have begun to send the file, redirects included."""

_LOOK_SECONDS = 15.0
"""Seconds between two looks for imports that another process has left."""

_RECORD_SECONDS = 3.0
"""Seconds between two records of the bytes received."""

_PAUSE_SECONDS = 5.0
"""Seconds before the second attempt; doubled for each further one."""


class Imports:
    """All operations on imports."""

    def __init__(
        self,
        connection: redis.Redis,
        storage: Storage,
        captures: Captures,
        quota: Quota,
        outgoing: Outgoing,
        settings: Settings,
    ) -> None:
        self.connection = connection
        self.storage = storage
        self.captures = captures
        self.quota = quota
        self.outgoing = outgoing
        self.settings = settings
        self.unfinished = Unfinished(
            connection,
            storage,
            "import",
            layout.unfinished_imports(),
            self._work,
            line=self._owner,
            exists=self._exists,
            turns=Turns(_CONCURRENT, _CONCURRENT_EACH),
            look_seconds=_LOOK_SECONDS,
        )
        captures.on_delete.append(
            lambda capture_id: self.unfinished.cancel(lambda name: name.startswith(f"{capture_id}."))
        )

    async def create(self, capture_id: str, request: CreateImport) -> Import:
        """Accept an import, which then runs in the background.

        Raises problems for an address that is refused (422), and for too many imports (429), and those of a capture.
        """
        await run_in_threadpool(self.captures.get, capture_id)
        try:
            await self.outgoing.check(request.url)
        except (AddressRefused, NoAnswer) as error:
            raise ProblemError("url_refused", str(error), advice="Give an address that is public.") from error
        made = Import(
            id=secrets.token_hex(8),
            capture=capture_id,
            url=request.url,
            role=request.role,
            name=request.name or _name_of(request.url),
            sha256=request.sha256,
            state=ImportState.queued,
            created_at=datetime.now(UTC),
        )
        await run_in_threadpool(self._accept, made)
        self.unfinished.wake()
        return made

    def _accept(self, made: Import) -> None:
        self.captures.check_room(made.capture, None)
        mark = layout.unfinished_import(made.capture, made.id)
        owner = self.unfinished.line_of(mark.split("/")[-1])
        # Until the mark is there: of many requests at once, each counts those before it.
        with exclusive(self.connection, "imports", owner):
            self._check_number(made, owner)
            self._write(made)
            self.storage.put(mark, b"{}")

    def _check_number(self, made: Import, owner: str) -> None:
        """Raise a 429 problem if the capture or its owner has too many imports that have not ended."""
        marks = [entry.path.split("/")[-1] for entry in self.storage.entries(layout.unfinished_imports())]
        for count, most, whose in (
            (sum(name.startswith(f"{made.capture}.") for name in marks), MAX_UNFINISHED, "The capture"),
            (sum(self.unfinished.line_of(name) == owner for name in marks), MAX_OF_OWNER, "The owner"),
        ):
            if count >= most:
                raise ProblemError(
                    "too_many_requests",
                    f"{whose} has {most} imports that have not ended.",
                    advice="Wait until some have ended, or import one zip archive in place of many files.",
                )

    def get(self, capture_id: str, import_id: str) -> Import:
        """Return an import. Raises a 404 problem."""
        record = self._read(capture_id, import_id) if layout.is_id(import_id) else None
        if record is None:
            raise ProblemError(
                "import_not_found",
                f"The capture has no import {import_id[:80]!r}.",
                advice="List the imports with GET /v1/captures/{id}/imports.",
            )
        return record

    def list(self, capture_id: str) -> list[Import]:
        """Return the imports of a capture, newest first."""
        self.captures.get(capture_id)
        entries = self.storage.entries(layout.capture_imports(capture_id))
        names = [entry.path.rsplit("/", 1)[-1].removesuffix(".json") for entry in entries]
        records = [record for name in names if (record := self._read(capture_id, name)) is not None]
        return sorted(records, key=lambda record: record.created_at, reverse=True)

    async def run(self) -> None:
        """Take up unfinished imports until this task is cancelled. A cancelled import is taken up again later."""
        await self.unfinished.run()

    def _owner(self, name: str) -> str:
        """Return the owner of an import, by the name of its mark; "" if its capture was deleted."""
        try:
            return self.captures.get_recent(name.partition(".")[0]).owner or DEFAULT_OWNER
        except (ProblemError, UnreadableRecord):
            return ""

    def _exists(self, name: str) -> bool:
        return self.storage.exists(layout.capture_record(name.partition(".")[0]))

    async def _work(self, name: str) -> float | None:
        """Make an attempt. Return the seconds until the next one, or None at the end of the import."""
        capture_id, _, import_id = name.partition(".")
        record = await run_in_threadpool(self._read, capture_id, import_id)
        if record is not None and not record.state.final and await run_in_threadpool(self._exists, name):
            record = record.model_copy(
                update={"state": ImportState.running, "attempts": record.attempts + 1, "received": 0}
            )
            await run_in_threadpool(self._write, record)
            record = await self._attempt(record)
            if record.state.final:
                record = record.model_copy(update={"finished_at": datetime.now(UTC)})
            await run_in_threadpool(self._write, record)
            if not record.state.final:
                return _PAUSE_SECONDS * float(2 ** (record.attempts - 1))
        elif record is not None and not record.state.final:  # written while the capture was being deleted
            await run_in_threadpool(self.storage.delete, layout.import_record(capture_id, import_id))
        await run_in_threadpool(self.storage.delete, layout.unfinished_import(capture_id, import_id))
        return None

    async def _attempt(self, record: Import) -> Import:
        """Return the import after an attempt: ended, or waiting for the next one."""
        try:
            async with asyncio.timeout(self.settings.import_seconds):
                return await self._fetch(record)
        except TimeoutError:
            limit = f"{self.settings.import_seconds:.0f} seconds"
            return _failed(record, "import_failed", f"The file did not arrive within {limit}.")
        except TooSlow as error:
            return _failed(record, "import_failed", str(error))
        except AddressRefused as error:
            return _failed(record, "url_refused", str(error))
        except (ProblemError, StorageError) as error:
            if isinstance(error, ProblemError):
                problem = error.problem
            else:
                log.warning("storage error", error=str(error), id=record.id)
                problem = problem_of_storage(error)
            # A 503 problem may pass, such as that of a storage that has not been listed yet.
            if problem.status == 503 and record.attempts < MAX_ATTEMPTS:
                return _tried(record, problem.detail)
            return record.model_copy(update={"state": ImportState.failed, "problem": problem})
        except redis.RedisError:
            raise  # the import waits until Redis answers, without which no lease is given
        except Exception as error:
            # Counted, whatever it is: what others send must not be fetched for ever.
            if isinstance(error, NoAnswer):
                return _tried(record, str(error))
            log.exception("an attempt ended unexpectedly", id=record.id)
            return _tried(record, f"The attempt ended in an unexpected error ({type(error).__name__}).")

    async def _fetch(self, record: Import) -> Import:
        async with AsyncExitStack() as stack:
            try:
                async with asyncio.timeout(_ANSWER_SECONDS):
                    asked = self.outgoing.request("GET", record.url, redirects=MAX_REDIRECTS)
                    answer = await stack.enter_async_context(asked)
            except TimeoutError:
                limit = f"{_ANSWER_SECONDS:.0f} seconds"
                raise NoAnswer(f"The other server did not begin to answer within {limit}.") from None
            _check(answer)
            record = record.model_copy(update={"size": answer.size})
            chunks = self._recorded(record, at_least(answer.chunks, self.settings.min_import_rate))
            async with self.quota.upload(
                None, record.capture, answer.size, beside=bytes_beside(record.name)
            ) as arrival:
                file, new = await self.captures.save_file(
                    record.capture,
                    record.role,
                    record.name,
                    arrival.counted(chunks),
                    announced_sha256=record.sha256,
                    announced_size=answer.size,
                )
                arrival.stored = file.size if new else 0
        return record.model_copy(
            update={"state": ImportState.succeeded, "received": file.size, "file": file, "name": file.name}
        )

    async def _recorded(self, record: Import, chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """Pass the bytes on, and record their number every few seconds."""
        received, written = 0, time.monotonic()
        async for chunk in chunks:
            received += len(chunk)
            if time.monotonic() - written >= _RECORD_SECONDS:
                await run_in_threadpool(self._write, record.model_copy(update={"received": received}))
                written = time.monotonic()
            yield chunk

    def _read(self, capture_id: str, import_id: str) -> Import | None:
        return read_record(self.storage, layout.import_record(capture_id, import_id), Import)

    def _write(self, record: Import) -> None:
        """Store the record, unless its capture was deleted."""
        if self.storage.exists(layout.capture_record(record.capture)):
            fields = record.model_dump(mode="json", exclude_none=True) | {"format": FORMAT}
            self.storage.put(layout.import_record(record.capture, record.id), json.dumps(fields).encode())


def _check(answer: Answer) -> None:
    """Raise NoAnswer for a status that may pass, and a problem for one that will not, or for an encoded body."""
    if answer.status in (408, 425, 429) or answer.status >= 500:
        raise NoAnswer(f"The other server answered with the status {answer.status}.")
    if answer.status != 200:
        raise ProblemError(
            "import_failed",
            f"The other server answered with the status {answer.status}.",
            advice="Check the address, and that it needs no login.",
            facts={"status": answer.status},
        )
    if answer.headers.get("content-encoding", "identity") != "identity":
        raise ProblemError(
            "import_failed", "The other server sent the file compressed, which was not asked for."
        )


def _tried(record: Import, reason: str) -> Import:
    """Return the import after an attempt that failed: waiting for the next one, or failed after the last."""
    if record.attempts >= MAX_ATTEMPTS:
        return _failed(record, "import_failed", f"{reason} It was tried {record.attempts} times.")
    log.info("an import is tried again", id=record.id, attempt=record.attempts, reason=reason)
    return record.model_copy(update={"state": ImportState.queued})


def _failed(record: Import, code: str, detail: str) -> Import:
    return record.model_copy(update={"state": ImportState.failed, "problem": Problem.of(code, detail)})


def _name_of(url: str) -> str:
    """Return the last part of an address as a file name. Raises a 422 problem if it is not one."""
    last = unquote(httpx.URL(url).raw_path.decode("ascii").partition("?")[0].rsplit("/", 1)[-1])
    try:
        return safe_name(last)
    except UnsafeName as error:
        raise ProblemError(
            "name_invalid", f"The address gives the file no name: {error}", advice="Send a `name`."
        ) from error
