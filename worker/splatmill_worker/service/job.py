"""One attempt at one job: stage the capture in, run the pipeline, say what happens, publish the model.

RQ calls `run_attempt` in a process of its own (see rq_worker). Whatever goes wrong ends as a named problem; what
would go wrong again is not tried again. A process that dies says nothing here: its parent does.
"""

import importlib
import logging
import os
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, Protocol, cast

from rq import get_current_job

from splatmill.backplane import events, layout, row
from splatmill.backplane.fold import fold
from splatmill.backplane.row import JobRow
from splatmill.backplane.storage import Storage, StorageError
from splatmill.schema import Event, JobState, LogEvent, PreviewEvent, StateEvent, TrainOptions
from splatmill_worker.errors import NothingUploaded
from splatmill_worker.service import attempt, publish
from splatmill_worker.service import shared_cameras as reconstruction
from splatmill_worker.service.attempt import Attempt, HandedBack
from splatmill_worker.service.lock import Held
from splatmill_worker.service.outbox import Outbox
from splatmill_worker.service.problems import Transient, problem_of
from splatmill_worker.service.workspace import Mirror, Workspace
from splatmill_worker.settings import storage_url

PIPELINE = os.environ.get("SPLATMILL_PIPELINE", "splatmill_worker.pipeline")
"""The module whose `run` does the work. The service's tests put a small one in its place."""

TRANSIENT_WAIT = 5.0
"""Seconds before an attempt that storage refused is tried again."""


class Outcome(Protocol):
    """What a pipeline returns: how it `ended`, "succeeded" or, as it was asked to, "cancelled"."""

    @property
    def ended(self) -> str: ...


Pipeline = Callable[[Path, Path, TrainOptions, Callable[[Event], None], Callable[[], bool]], Outcome]

log = logging.getLogger("splatmill_worker")


def run_attempt() -> None:
    """Run the attempt that `attempt.current` describes, in the process forked for it."""
    this = attempt.current
    assert this is not None
    request = _wanted(this)
    if request is not None:
        outbox = Outbox(this)
        try:
            _attempt(this, request, outbox)
        except HandedBack:
            outbox.flush(5.0)
            os._exit(attempt.HANDED_BACK)
        finally:
            outbox.close()
    this.lock.release()


def _wanted(this: Attempt) -> JobRow | None:
    """The job's row, or None when there is nothing left to do: deleted, restarted meanwhile, or ended."""
    found = row.read(this.connection, this.job_id)
    if found is None or found.generation != this.generation:
        return None
    if fold(found, events.read_states(this.connection, this.job_id)).state.final:
        return None
    if found.cancel_requested_at is not None:
        os._exit(attempt.WITHDRAWN)
    return found


def _attempt(this: Attempt, request: JobRow, outbox: Outbox) -> None:
    handler = _LogLines(outbox)
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        outbox.put(StateEvent(state=JobState.preparing))
        storage = Storage(storage_url())
        if not publish.published(storage, this):
            _work(this, request, storage, outbox)
        outbox.put(StateEvent(state=JobState.succeeded))
    except Exception as error:  # the one place where every failure of a job becomes a sentence
        if attempt.hand_back_requested():
            raise HandedBack from error
        _fail(this, error, outbox)
    finally:
        log.removeHandler(handler)


def _work(this: Attempt, request: JobRow, storage: Storage, outbox: Outbox) -> None:
    space = Workspace(storage, this.job_id, request.capture)
    restored = space.restore()
    if restored:
        log.info("Taking up what an attempt elsewhere left: %d files.", len(restored))
    if not space.stage_in():
        raise NothingUploaded(request.capture)
    if reconstruction.fetch(storage, request.capture, space.run):
        log.info("The cameras of this capture were recovered before; they are used again.")
    if request.options.start_model is not None:
        space.stage_start(request.options.start_model)
    mirror = Mirror(space, log.warning)
    try:
        run = cast(Pipeline, importlib.import_module(PIPELINE).run)
        outcome = run(
            space.capture,
            space.run,
            request.options,
            lambda event: _pass_on(event, space, outbox),
            attempt.hand_back_requested,
        )
    except BaseException as error:
        mirror.close(copy=attempt.hand_back_requested())
        if isinstance(error, Exception) and not attempt.hand_back_requested() and _is_final(error):
            space.start_over()
        raise
    handed_back = outcome.ended == "cancelled"
    mirror.close(copy=handed_back)
    if handed_back:
        raise HandedBack
    if this.lock.refresh() is Held.lost:
        _superseded()
    publish.publish(storage, this, request, space.run / "out")
    space.remove()


def _pass_on(event: Event, space: Workspace, outbox: Outbox) -> None:
    """Send an event of the pipeline on; a preview is stored first, a final state is not the pipeline's to say."""
    if isinstance(event, StateEvent) and event.state.final:
        return
    if isinstance(event, PreviewEvent):
        target = layout.model_file(space.job_id, "preview.jpg")
        try:
            space.storage.put(target, (space.run / event.path).read_bytes())
        except (StorageError, OSError) as error:
            outbox.put(LogEvent(level="warning", message=f"A preview could not be stored: {error}"))
            return
        event = PreviewEvent(path=target, step=event.step)
    outbox.put(event)
    if isinstance(event, StateEvent) and event.state is JobState.training:
        try:
            reconstruction.share(space.storage, space.capture_id, space.run)
        except StorageError as error:
            # Only later jobs would have been the faster for it.
            outbox.put(LogEvent(level="warning", message=f"The cameras could not be shared: {error}"))


def _fail(this: Attempt, error: Exception, outbox: Outbox) -> None:
    """End the job by name, or raise to have it tried again."""
    trace = "".join(traceback.format_exception(error))
    print(trace, flush=True)
    try:
        problem = problem_of(error)
    except Transient as transient:
        problem = transient.problem
        outbox.flush()  # waits for Redis, if that is what went away
        entry = get_current_job(connection=this.connection)
        if entry is not None and entry.should_retry:
            outbox.put(LogEvent(level="warning", message=f"{problem.detail} Trying again."))
            outbox.put(StateEvent(state=JobState.queued))
            outbox.flush()
            _wait(TRANSIENT_WAIT)
            raise
    if problem.code == "internal_error":
        outbox.put(LogEvent(level="error", message=trace[-20_000:]))
    outbox.put(LogEvent(level="error", message=problem.sentence[:20_000]))
    outbox.put(StateEvent(state=JobState.failed, problem=problem))
    outbox.flush()


def _is_final(error: Exception) -> bool:
    try:
        problem_of(error)
    except Transient:
        return False
    return True


def _wait(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if attempt.hand_back_requested():
            raise HandedBack
        time.sleep(0.1)


def _superseded() -> NoReturn:
    """Another attempt has the job: leave without a trace. The parent notices at its next heartbeat as well."""
    print("Another attempt holds the job's lock; this one ends without publishing.", flush=True)
    os._exit(1)


class _LogLines(logging.Handler):
    """Python's log records of the engine, as log events of the job."""

    def __init__(self, outbox: Outbox) -> None:
        super().__init__(logging.INFO)
        self._outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        level = cast(Any, "error" if record.levelno >= 40 else "warning" if record.levelno >= 30 else "info")
        self._outbox.put(LogEvent(level=level, message=self.format(record)[:20_000]))
