"""A job on the server: its state, its events and its results."""

import asyncio
import time
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from contextlib import aclosing
from typing import Any

from splatmill.errors import Conflict, ConnectionFailed, JobCancelled, JobFailed, Unavailable, WaitTimeout
from splatmill.schema import (
    Curve,
    CurveRow,
    EventRecord,
    Job,
    JobState,
    LogLine,
    LogPage,
    Placement,
    Problem,
    Progress,
    ProgressEvent,
    Report,
    StateEvent,
    Watch,
)
from splatmill.sdk.model import AsyncModelHandle, find_model, label_changes
from splatmill.transfer.connection import Connection, backoff, read_answer
from splatmill.transfer.sse import GIVE_UP_SECONDS, follow_events
from splatmill.transfer.uploads import OnProgress

MOST_LINES = 10_000
"""Number of log lines that the server returns at most."""


class AsyncJobHandle:
    """A job on the server."""

    def __init__(self, connection: Connection, job: Job) -> None:
        self.connection = connection
        self.job = job
        """The record of the job, as of the last request."""
        self.refused: tuple[tuple[str, Problem], ...] = ()
        """Names of the photos that the server refused in the upload, each with the reason."""
        self.renamed: tuple[tuple[str, str], ...] = ()
        """Names of the files that are stored under other names, each with its name in the capture."""

    @property
    def id(self) -> str:
        """The id of the job and of its model."""
        return self.job.id

    @property
    def state(self) -> JobState:
        """The state, as of the last request."""
        return self.job.state

    async def refresh(self) -> Job:
        """Request the current record of the job."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}")
        self.job = read_answer(Job, response)
        return self.job

    async def rename(self, name: str | None) -> Job:
        """Name the job, and its model with it; None takes the name away. Returns the record."""
        return await self._change({"name": name})

    async def label(self, *, tags: Sequence[str] | None = None, favourite: bool | None = None) -> Job:
        """Give the job, and its model with it, these tags in place of those it has, or a star. Returns the record.

        None leaves them as they are. Raises InvalidRequest for more than 12 tags, or ones over 40 characters.
        """
        return await self._change(label_changes(tags, favourite))

    async def _change(self, labels: Mapping[str, Any]) -> Job:
        response = await self.connection.request("PATCH", f"/v1/jobs/{self.id}", json=labels, repeatable=True)
        self.job = read_answer(Job, response)
        return self.job

    def events(self, after: str | None = None) -> AsyncIterator[EventRecord]:
        """Yield the events of the job until it ends. A lost connection is restored without losing events.

        `after` is the id of the last event already seen; without it, the events begin at the start of the job.
        """
        return self._events(after)

    async def _events(self, after: str | None = None) -> AsyncGenerator[EventRecord, None]:
        empty = 0  # streams in a row that ended without an event
        while True:
            empty += 1
            # It is closed with this generator; the end of the loop would interrupt the closing of its connection.
            async with aclosing(
                follow_events(self.connection, f"/v1/jobs/{self.id}/events", after=after)
            ) as records:
                async for record in records:
                    after, empty = record.id, 0
                    yield record
            if (await self._refresh_patiently()).state.final:
                return
            if empty:  # do not poll a server that ends its streams at once
                await asyncio.sleep(backoff(empty))

    async def _refresh_patiently(self) -> Job:
        """Request the current record, and wait while a part of the service is down."""
        end = time.monotonic() + GIVE_UP_SECONDS
        while True:
            try:
                return await self.refresh()
            except (Unavailable, ConnectionFailed):  # `refresh` has waited as the server asked to
                if time.monotonic() > end:
                    raise
                await asyncio.sleep(backoff(self.connection.retries + 1))

    async def wait(
        self, on_progress: OnProgress | None = None, *, timeout: float | None = None
    ) -> AsyncModelHandle:
        """Wait for the job to end and return its model. Raises JobFailed or JobCancelled when it ends without one.

        `on_progress` is called with each step of progress. `timeout` is the number of seconds to wait; left out, as
        long as the job takes. Raises WaitTimeout after the timeout, and the job continues.
        """
        try:
            async with asyncio.timeout(timeout) as limit, aclosing(self._events()) as records:
                async for record in records:
                    if isinstance(record.event, StateEvent):
                        self.job = self.job.model_copy(update={"state": record.event.state})
                    if on_progress is not None and isinstance(record.event, ProgressEvent):
                        on_progress(Progress.model_validate(record.event.model_dump(exclude={"type"})))
        except TimeoutError as error:
            if not limit.expired() or timeout is None:
                raise
            raise WaitTimeout(self.id, self.state.value, timeout) from error
        return await self.result()

    async def result(self) -> AsyncModelHandle:
        """Return the model of a job that has ended. Raises JobFailed, JobCancelled, or Conflict while it runs."""
        job = await self.refresh()
        if job.state is JobState.succeeded:
            return await find_model(self.connection, job.model or job.id)
        if job.state is JobState.cancelled:
            raise JobCancelled(job.id)
        if job.state is JobState.failed:
            problem = job.problem or Problem.of(
                "internal_error", f"The job {job.id} failed, and the server gave no reason."
            )
            raise JobFailed(job.id, problem)
        detail = f"The job {job.id} is {job.state.value}; its model is not finished."
        raise Conflict(Problem.of("model_not_ready", detail))

    async def cancel(self) -> Job:
        """Request the cancellation of the job. Its state becomes cancelled once its process has ended."""
        return await self._post("cancel")

    async def restart(self) -> Job:
        """Run a job that has ended again, from its last checkpoint if there is one."""
        return await self._post("restart")

    async def delete(self) -> None:
        """Delete the job, its model and its files."""
        await self.connection.request("DELETE", f"/v1/jobs/{self.id}")

    async def report(self) -> Report:
        """Return the report: error against run time, the plan, and where it ran."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/report")
        return read_answer(Report, response)

    async def logs(self, *, limit: int = MOST_LINES) -> list[LogLine]:
        """Return the log of the job, oldest line first.

        `limit` is the largest number of lines; the last ones are returned.
        """
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/logs", params={"limit": limit})
        return read_answer(LogPage, response).lines

    async def curve(self) -> list[CurveRow]:
        """Return the error against run time that was measured so far, from the first measurement on."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/curve")
        return read_answer(Curve, response).rows

    async def preview(self) -> bytes:
        """Return the newest preview image (JPEG)."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/preview")
        return response.content

    async def cameras(self) -> Placement:
        """Return the cameras and points as structure from motion places them, and the photos that are not used."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/cameras")
        return read_answer(Placement, response)

    async def watch(self) -> float:
        """Ask the job for snapshots of its scene, and return for how many seconds it makes them without being asked.

        While it does, events announce the snapshots. A job that has ended makes none: 0.
        """
        response = await self.connection.request("POST", f"/v1/jobs/{self.id}/watch", repeatable=True)
        return read_answer(Watch, response).seconds

    async def snapshot(self) -> bytes:
        """Return the newest snapshot of the scene in training: a compressed .ply without spherical harmonics.

        Only a job that is watched makes snapshots. Raises NotFound while there is none.
        """
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/snapshot")
        return response.content

    async def _post(self, action: str) -> Job:
        # The server treats a repeated cancel or restart as one.
        response = await self.connection.request("POST", f"/v1/jobs/{self.id}/{action}", repeatable=True)
        self.job = read_answer(Job, response)
        return self.job
