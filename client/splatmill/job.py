"""A job on the server: its events, its end, and the wishes one can have about it."""

import asyncio
import time
from collections.abc import AsyncIterator

from splatmill.connection import Connection, pause, read_answer
from splatmill.errors import Conflict, ConnectionFailed, JobCancelled, JobFailed, Unavailable
from splatmill.model import AsyncModelHandle, find_model
from splatmill.schema import (
    EventRecord,
    Job,
    JobState,
    LogLine,
    LogPage,
    Problem,
    Progress,
    ProgressEvent,
    Report,
)
from splatmill.sse import PATIENCE, follow
from splatmill.uploads import OnProgress


class AsyncJobHandle:
    """A job on the server. `job` is what was last heard of it."""

    def __init__(self, connection: Connection, job: Job) -> None:
        self.connection = connection
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
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}")
        self.job = read_answer(Job, response)
        return self.job

    async def events(self, after: str | None = None) -> AsyncIterator[EventRecord]:
        """What happens, as it happens, until the job's end; lost connections are taken up again.

        `after` is the id of an event to go on after; without it the stream begins at the job's beginning.
        """
        silent = 0
        while True:
            silent += 1
            async for record in follow(self.connection, f"/v1/jobs/{self.id}/events", after=after):
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
                await asyncio.sleep(pause(self.connection.retries + 1))

    async def wait(self, on_progress: OnProgress | None = None) -> AsyncModelHandle:
        """The model, once the job is done; raises JobFailed or JobCancelled when it ends without one."""
        async for record in self.events():
            if on_progress is not None and isinstance(record.event, ProgressEvent):
                on_progress(Progress.model_validate(record.event.model_dump(exclude={"type"})))
        return await self.result()

    async def result(self) -> AsyncModelHandle:
        """The model of a job that has ended; raises JobFailed, JobCancelled, or Conflict while it runs."""
        job = await self.refresh()
        if job.state is JobState.succeeded:
            return await find_model(self.connection, job.model or job.id)
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
        await self.connection.request("DELETE", f"/v1/jobs/{self.id}")

    async def report(self) -> Report:
        """Error against run time, and what led to it."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/report")
        return read_answer(Report, response)

    async def logs(self) -> list[LogLine]:
        """The job's log, oldest line first."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/logs")
        return read_answer(LogPage, response).lines

    async def preview(self) -> bytes:
        """The newest preview picture (JPEG)."""
        response = await self.connection.request("GET", f"/v1/jobs/{self.id}/preview")
        return response.content

    async def _post(self, wish: str) -> Job:
        # Wishing twice is wishing once.
        response = await self.connection.request("POST", f"/v1/jobs/{self.id}/{wish}", repeatable=True)
        self.job = read_answer(Job, response)
        return self.job
