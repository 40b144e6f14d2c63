"""One attempt at a job: stages the capture, runs the pipeline, reports its events and stores the model.

It runs in a process of its own (see rq_worker). Each failure becomes a named problem, and only transient ones are
retried. When the process is killed, its parent reports the failure.
"""

import logging
import os
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, Protocol, cast

import redis

from splatmill.backplane.jobs import events
from splatmill.backplane.jobs import row as rows
from splatmill.backplane.jobs.fold import fold
from splatmill.backplane.jobs.published import is_published
from splatmill.backplane.jobs.row import JobRow
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill.schema import (
    CamerasEvent,
    Event,
    JobState,
    LogEvent,
    PreviewEvent,
    ProgressEvent,
    StateEvent,
    TrainOptions,
)
from splatmill_worker.errors import EmptyCapture, QuotaReached
from splatmill_worker.service import hand_back
from splatmill_worker.service.attempts import publish, sfm_cache
from splatmill_worker.service.attempts.attempt import LONGEST_MESSAGE, Attempt
from splatmill_worker.service.attempts.live_view import LiveView
from splatmill_worker.service.attempts.mirror import Mirror
from splatmill_worker.service.attempts.outbox import Outbox
from splatmill_worker.service.attempts.problems import (
    is_decoder_end,
    is_transient,
    keeps_progress,
    problem_of,
)
from splatmill_worker.service.disk_reserve import DiskWatch
from splatmill_worker.service.hand_back import HandedBack
from splatmill_worker.service.job_folder import ENDED, JobFolder, remove_remade
from splatmill_worker.service.lock import LockState
from splatmill_worker.service.process_exit import HANDED_BACK_STATUS, UNREPORTED_STATUS, WITHDRAWN_STATUS
from splatmill_worker.service.redis_patience import PATIENCE, patiently
from splatmill_worker.service.room import Room
from splatmill_worker.settings import storage_url

RETRY_SECONDS = 5.0
"""Seconds between a transient failure and the end of its attempt, after which the queue tries again."""

STAGING = "staging"
"""The stage in which the files of a capture come from storage, as progress events name it."""

SILENT_SECONDS = 0.5
"""Seconds before the first of these events. A capture that is linked, or small, has none."""

RESTORE_SECONDS = 30.0
"""Seconds that an attempt waits until a server has restored its job, which a Redis that came back empty has lost."""

FLUSH_SECONDS = 5.0
"""Seconds that an attempt which is handed back may spend on sending its last events."""


class PipelineResult(Protocol):
    """What a pipeline returns. `ended` is "succeeded", or "cancelled" when it was asked to stop."""

    @property
    def ended(self) -> str: ...


class Pipeline(Protocol):
    """What does the work of an attempt.

    capture, workdir: the capture folder and the run folder.
    emit: takes each event.
    cancelled: returns whether to stop.
    onlookers: those who look at the job through the API.
    """

    def __call__(
        self,
        capture: Path,
        workdir: Path,
        options: TrainOptions,
        emit: Callable[[Event], None],
        cancelled: Callable[[], bool],
        *,
        onlookers: LiveView,
    ) -> PipelineResult: ...


LoadPipeline = Callable[[], Pipeline]
"""Returns the pipeline, which is imported in the process of the attempt only: numpy and torch start threads."""

log = logging.getLogger("splatmill_worker")
"""Its lines go to the log of the job."""

own_log = logging.getLogger("splatmill.attempt")
"""Its lines go to the log of the worker alone."""


def run_attempt(attempt: Attempt, load: LoadPipeline, *, can_retry: bool) -> None:
    """Run an attempt to the end, in a process forked for it.

    load: returns what does the work.
    can_retry: whether the queue tries again when this raises.

    Reports the job's final state, or exits the process with HANDED_BACK_STATUS, WITHDRAWN_STATUS, or, if Redis fails
    for longer than PATIENCE, UNREPORTED_STATUS. Raises a transient failure while the queue can retry.
    """
    try:
        row = patiently(lambda: _row_to_run(attempt))
    except redis.RedisError as error:
        _exit_unreported(str(error))
    except HandedBack:
        os._exit(HANDED_BACK_STATUS)
    if row is not None:
        outbox = Outbox(attempt)
        try:
            _run(attempt, load, row, outbox, can_retry)
        except HandedBack:
            outbox.flush(FLUSH_SECONDS)
            os._exit(HANDED_BACK_STATUS)
        finally:
            if not outbox.close():
                _exit_unreported(outbox.trouble)
    patiently(attempt.lock.release)


def _row_to_run(attempt: Attempt) -> JobRow | None:
    """Return the job's row; None when the job was deleted or restarted meanwhile, or has ended."""
    row = rows.read(attempt.connection, attempt.job_id) or _restored_row(attempt)
    if row is None or row.generation != attempt.generation:
        return None
    if fold(row, events.read_states(attempt.connection, attempt.job_id)).state.final:
        return None
    if row.cancel_requested_at is not None:
        os._exit(WITHDRAWN_STATUS)
    return row


def _restored_row(attempt: Attempt) -> JobRow | None:
    """Return the row of a job that Redis has lost, once a server has restored it; None for a job that was deleted.

    Raises HandedBack when that takes longer than RESTORE_SECONDS, when the worker stops, and when storage cannot tell:
    the job then waits in the queue.
    """
    end = time.monotonic() + RESTORE_SECONDS
    try:
        storage = Storage(storage_url())
        while storage.exists(layout.unfinished_job(attempt.job_id)):
            if (row := rows.read(attempt.connection, attempt.job_id)) is not None:
                return row
            if time.monotonic() > end or hand_back.requested():
                raise HandedBack
            time.sleep(0.5)
    except StorageError as error:
        own_log.warning("storage does not tell whether the job %s exists: %s", attempt.job_id, error)
        raise HandedBack from error
    return rows.read(attempt.connection, attempt.job_id)


def _run(attempt: Attempt, load: LoadPipeline, row: JobRow, outbox: Outbox, can_retry: bool) -> None:
    handler = _LogEventHandler(outbox)
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        outbox.put(StateEvent(state=JobState.preparing))
        storage = Storage(storage_url())
        if not is_published(storage, attempt.job_id, attempt.generation):
            _train_and_publish(attempt, load, row, storage, outbox)
        outbox.put(StateEvent(state=JobState.succeeded))
    except Exception as error:  # the one place where a failure of a job becomes a problem
        if hand_back.requested():
            raise HandedBack from error
        _report_failure(error, outbox, can_retry)
    finally:
        log.removeHandler(handler)


def _train_and_publish(
    attempt: Attempt, load: LoadPipeline, row: JobRow, storage: Storage, outbox: Outbox
) -> None:
    folder = JobFolder(storage, attempt.job_id, row.capture)
    room = Room(attempt.connection, row.owner, attempt.job_id)
    disk = DiskWatch()
    try:
        _train(attempt, load, row, folder, room, disk, outbox)
    except Exception as error:
        # Native code reports a full disk in many ways; the watch knows better.
        if disk.error is not None and not hand_back.requested():
            raise disk.error from error
        raise
    finally:
        disk.close()
    if patiently(attempt.lock.refresh) is LockState.lost:
        _exit_superseded()
    # The room of what was unpacked is needed for the model.
    remove_remade(folder.path)
    room.release_unpacked()
    publish.publish(storage, attempt, row, folder.run / "out", room)
    folder.remove()


def _train(
    attempt: Attempt,
    load: LoadPipeline,
    row: JobRow,
    folder: JobFolder,
    room: Room,
    disk: DiskWatch,
    outbox: Outbox,
) -> None:
    """Stage the capture and run the pipeline to its end. Raises HandedBack, DiskReserveReached and its errors."""
    if disk.error is not None:
        raise disk.error
    storage = folder.storage
    restored = folder.restore()
    if restored:
        log.info("Resuming from %d files that an attempt on another machine stored.", len(restored))
    if not folder.stage_capture(_StagingProgress(outbox)):
        raise EmptyCapture(row.capture)
    if sfm_cache.fetch(storage, row.capture, folder.run):
        log.info("Using the cameras that an earlier job recovered from this capture.")
    if row.options.start_model is not None:
        folder.stage_start(row.options.start_model)

    def stopped() -> bool:
        return hand_back.requested() or disk.error is not None

    mirror = Mirror(folder, room, log.warning)
    live = LiveView(attempt, outbox.put)
    try:
        # Not imported by the worker that forks this process: numpy and the decoders start threads.
        from splatmill_worker.images.archives import unpacked_room
        from splatmill_worker.images.decoding import decoders

        folder.run.mkdir(parents=True, exist_ok=True)
        with (
            decoders.confined([folder.path], folder.run / ENDED, stopped),
            unpacked_room.claimed_by(room.unpack),
        ):
            result = _pipeline(attempt, load, row, folder, room)(
                folder.capture,
                folder.run,
                row.options,
                lambda event: _forward(event, folder, room, outbox),
                stopped,
                onlookers=live,
            )
    except BaseException as error:
        # The next attempt, perhaps on another machine, needs the list of files that it must not open.
        mirror.close(copy=hand_back.requested() or is_decoder_end(error))
        if isinstance(error, Exception) and not stopped() and not keeps_progress(error):
            folder.reset()
        raise
    finally:
        live.close()
    ended_early = result.ended == "cancelled"
    mirror.close(copy=ended_early)
    if ended_early:
        raise HandedBack if disk.error is None or hand_back.requested() else disk.error


def _pipeline(attempt: Attempt, load: LoadPipeline, row: JobRow, folder: JobFolder, room: Room) -> Pipeline:
    """What does the work of the job: of a scene in tiles, other workers do some."""
    pipeline = (
        load()
    )  # for a scene in tiles too: a module that SPLATMILL_PIPELINE names may record what its units do
    if row.options.tiles is None:
        return pipeline
    from splatmill_worker.service.units.other_workers import OtherWorkers
    from splatmill_worker.tiles import job

    others = OtherWorkers(attempt.connection, folder, attempt.generation, room, log.warning)
    return partial(job.run, others=others)


def _forward(event: Event, folder: JobFolder, room: Room, outbox: Outbox) -> None:
    """Send an event of the pipeline, and store the files that belong to it.

    A preview and a placement of cameras are stored before they are announced. When training begins, the recovered
    cameras are stored for other jobs.
    Final states are dropped: the service reports them once the model is stored.
    """
    if isinstance(event, StateEvent) and event.state.final:
        return
    if isinstance(event, PreviewEvent):
        target = layout.model_file(folder.job_id, "preview.jpg")
        try:
            _store(folder, room, "preview.jpg", target, event.path)
        except (StorageError, OSError, QuotaReached) as error:
            outbox.put(LogEvent(level="warning", message=f"A preview could not be stored: {error}"))
            return
        event = PreviewEvent(path=target, step=event.step)
    if isinstance(event, CamerasEvent):
        target = layout.job_cameras(folder.job_id)
        try:
            _store(folder, room, "placed cameras", target, event.path)
        except (StorageError, OSError, QuotaReached) as error:
            outbox.put(LogEvent(level="warning", message=f"The cameras to show could not be stored: {error}"))
            return
        event = event.model_copy(update={"path": target})
    outbox.put(event)
    if isinstance(event, StateEvent) and event.state is JobState.training:
        try:
            sfm_cache.store(folder.storage, folder.capture_id, folder.run, room)
        except (StorageError, QuotaReached, redis.RedisError) as error:
            # The job itself has the cameras in its folder.
            message = f"The recovered cameras could not be stored for other jobs on this capture: {error}"
            outbox.put(LogEvent(level="warning", message=message))


def _store(folder: JobFolder, room: Room, name: str, target: str, path: str) -> None:
    content = (folder.run / path).read_bytes()
    room.store({name: len(content)})
    folder.storage.put(target, content)


def _report_failure(error: Exception, outbox: Outbox, can_retry: bool) -> None:
    """Report the failure of the job, or raise a transient one again while the queue can retry."""
    trace = "".join(traceback.format_exception(error))
    with suppress(OSError):  # the disk of the worker's log may be full, which may be the failure
        own_log.error("the attempt failed", exc_info=error)
    problem = problem_of(error)
    if is_transient(error):
        if not outbox.flush():  # waits until Redis is back, if its absence was the failure
            _exit_unreported(outbox.trouble)
        if can_retry:
            outbox.put(LogEvent(level="warning", message=f"{problem.detail} The job is tried again."))
            outbox.put(StateEvent(state=JobState.queued))
            outbox.flush()
            _wait(RETRY_SECONDS)
            raise error
    if problem.code == "internal_error":
        outbox.put(LogEvent(level="error", message=trace[-LONGEST_MESSAGE:]))
    outbox.put(LogEvent(level="error", message=problem.sentence[:LONGEST_MESSAGE]))
    outbox.put(StateEvent(state=JobState.failed, problem=problem))
    outbox.flush()


def _wait(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if hand_back.requested():
            raise HandedBack
        time.sleep(0.1)


def _exit_unreported(trouble: str | None) -> NoReturn:
    """End without a report, because Redis took none. The parent puts the job back into the queue once Redis works."""
    own_log.error("Redis took no events for %g s (%s); this attempt ends.", PATIENCE, trouble)
    os._exit(UNREPORTED_STATUS)


def _exit_superseded() -> NoReturn:
    """End without publishing: another attempt has the job's lock. The parent notices at its next heartbeat too."""
    own_log.error("Another attempt holds the job's lock; this one ends without storing its model.")
    os._exit(1)


class _StagingProgress:
    """Sends the progress of the staging of a capture as events. Raises HandedBack once the worker stops."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._first = time.monotonic() + SILENT_SECONDS

    def __call__(self, done: int, total: int) -> None:
        if hand_back.requested():
            raise HandedBack
        if time.monotonic() >= self._first:
            self._outbox.put(
                ProgressEvent(stage=STAGING, done=done, total=total, note="files of the capture")
            )


class _LogEventHandler(logging.Handler):
    """Sends Python log records as log events of the job."""

    def __init__(self, outbox: Outbox) -> None:
        super().__init__(logging.INFO)
        self._outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        level = cast(Any, "error" if record.levelno >= 40 else "warning" if record.levelno >= 30 else "info")
        self._outbox.put(LogEvent(level=level, message=self.format(record)[:LONGEST_MESSAGE]))
