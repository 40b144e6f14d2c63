"""Whether a job may be made or started again: no other code decides this.

What the request names is checked first, and room is reserved for the job. What other requests may change meanwhile is
checked in the transaction that inserts the job: that nothing it needs is being deleted, and how many unfinished jobs
its owner has.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import cast

import redis

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    PHOTO_SUFFIXES,
    BinKind,
    CreateJob,
    EstimateJob,
    Job,
    Role,
    StoredKind,
    TrainOptions,
)
from splatmill.schema.files.formats import is_start_file
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.jobs.estimate import check_time
from splatmill_server.jobs.finished import Finished
from splatmill_server.jobs.records import Jobs, job_not_found
from splatmill_server.models import Models
from splatmill_server.space.bin import Bin
from splatmill_server.space.deletion import DELETED, DELETING
from splatmill_server.space.holdings import Holding
from splatmill_server.space.quota import Quota


class Admission:
    """Makes the jobs that may be made. Methods raise ProblemError, StorageError and redis.RedisError."""

    def __init__(
        self,
        storage: Storage,
        captures: Captures,
        jobs: Jobs,
        models: Models,
        quota: Quota,
        records_bin: Bin,
        finished: Finished,
    ) -> None:
        self.storage = storage
        self.captures = captures
        self.jobs = jobs
        self.models = models
        self.quota = quota
        self.bin = records_bin
        self.finished = finished

    def create(
        self, who: Caller, request: CreateJob, *, key: str | None = None, body: str = ""
    ) -> tuple[Job, bool]:
        """Create a job if it may be made; return it, and whether it is new. `key` and `body` are as for `Jobs.create`.

        Raises problems for a capture that is not there (404) or cannot be trained (422), a model to start from that is
        not there (404) or not finished (409), too many unfinished jobs (429), and a quota that is used up (507).
        """
        known = self.jobs.get_id_of_key(who.owner, key) if key is not None else None
        # A repeated request returns its job even if the capture was deleted meanwhile.
        is_new = known is None or self.jobs.get_owner(known) is None
        if is_new:
            self.captures.check_visible(who, request.capture)
            self._check_trainable(request.capture, request.options)
            self._check_start(who, request)
        needs = needs_of(request.capture, request.options)

        def check() -> None:
            check_marks(self.jobs.connection, self.storage, needs)
            self._check_number(who, who.owner)

        with self.quota.job(who, who.owner) if is_new else nullcontext() as keep_room:
            job, new = self.jobs.create(
                request, owner=who.owner, key=key, body=body, check=check, watched=mark_keys(needs)
            )
            if new and keep_room is not None:
                keep_room(job.id)
        if new:
            self._take_out_of_bin(request.capture, request.options)
        return job, new

    def restart(self, who: Caller, job_id: str) -> Job:
        """Enqueue a job that has ended again, if it may run; a job that waits stays as it is.

        Raises problems for a job or a capture that is not there (404), a job that runs (409), too many unfinished jobs
        (429), and a quota that is used up (507).
        """
        if (waiting := self.jobs.waiting(job_id)) is not None:
            return waiting
        with self.quota.job(who, self.jobs.get_owner(job_id) or who.owner) as keep_room:
            row = self.jobs.get_row(job_id)
            needs = needs_of(row.capture, row.options)
            own_mark = mark_keys([(StoredKind.model, job_id)])[0]

            def check() -> None:
                if not self.storage.exists(layout.capture_record(row.capture)):
                    raise ProblemError(
                        "capture_not_found",
                        f"The job's capture {row.capture} was deleted.",
                        advice="Upload the photos again and create a new job.",
                    )
                check_marks(self.jobs.connection, self.storage, needs)
                if self.jobs.connection.get(own_mark) == DELETING:
                    raise job_not_found(job_id)
                self._check_number(who, row.owner)

            restarted = self.jobs.restart(job_id, check=check, watched=[*mark_keys(needs), own_mark])
            keep_room(job_id)
        self.bin.take_out(BinKind.job, job_id)
        self._take_out_of_bin(row.capture, row.options)
        return restarted

    def _take_out_of_bin(self, capture_id: str, options: TrainOptions) -> None:
        """Take out of the bin what a job uses that was just made."""
        self.bin.take_out(BinKind.capture, capture_id)
        if options.start_model is not None:
            self.bin.take_out(BinKind.job, options.start_model)

    def _check_trainable(self, capture_id: str, options: TrainOptions) -> None:
        """Raise a 404 or 422 problem for a capture that certainly cannot be trained: it has no photos or only one, or
        more than the jobs that have finished here could train in the time of the options.
        """
        self.captures.get(capture_id)
        images = list(self.storage.entries(layout.capture_files(capture_id, Role.images)))
        if not images:
            raise ProblemError(
                "no_images",
                "The capture holds no images.",
                advice="Upload photos, a video or a zip archive with PUT "
                "/v1/captures/{id}/images/{name} first.",
            )
        photos = all(entry.path.lower().endswith(PHOTO_SUFFIXES) for entry in images)
        poses = self.storage.entries(layout.capture_files(capture_id, Role.poses))
        # A model to start from is no pose, and neither is a depth map.
        posed = any(
            not is_start_file(entry.path) and not entry.path.lower().endswith(PHOTO_SUFFIXES)
            for entry in poses
        )
        if len(images) == 1 and photos and not posed:
            raise ProblemError(
                "too_few_images",
                "The capture holds one photo; depth cannot be recovered from a single photo.",
                advice="Take 20 or more photos from different positions, each overlapping the next by "
                "two thirds.",
                facts={"images": 1},
            )
        if options.within is not None and photos:
            request = EstimateJob(photos=len(images), posed=posed, options=options)
            check_time(request, self.finished.newest(), recovered=self.captures.has_cameras(capture_id))

    def _check_start(self, who: Caller, request: CreateJob) -> None:
        """Raise a problem if the model to start from, where the request names one, is not there for the caller."""
        name, model_id = request.options.start_file, request.options.start_model
        if name is not None and not self.storage.exists(
            layout.capture_file(request.capture, Role.poses, name)
        ):
            raise ProblemError(
                "file_not_found",
                f"The file to start from, {name[:80]!r}, is not among the poses of the capture.",
                advice="Upload it with PUT /v1/captures/{id}/poses/{name} first, or give the id of a "
                "stored model.",
            )
        if model_id is not None:
            self.models.check_visible(who, model_id)
            self.models.check(model_id)

    def _check_number(self, who: Caller, owner: str) -> None:
        """Raise a 429 problem if the owner has as many unfinished jobs as the key of the caller permits."""
        most = who.limits.unfinished_jobs
        if most is not None and (count := self.jobs.count_unfinished(owner)) >= most:
            raise ProblemError(
                "too_many_jobs",
                f"The owner {owner!r} has {count} unfinished jobs, and its API key permits {most} at once.",
                advice="Wait until one has ended, or cancel one with POST /v1/jobs/{id}/cancel.",
                facts={"unfinished_jobs": count, "limit": most},
            )


def needs_of(capture: str, options: TrainOptions) -> list[tuple[StoredKind, str]]:
    """Return what a job on this capture with these options needs: the capture, and a model to start from."""
    start = options.start_model
    return [(StoredKind.capture, capture), *([(StoredKind.model, start)] if start is not None else [])]


def mark_keys(needs: Sequence[tuple[StoredKind, str]]) -> list[str]:
    """Return the keys in Redis of the marks on these records, for a transaction to watch."""
    return [keys.deleting(Holding(kind=kind, id=record_id).key) for kind, record_id in needs]


def check_marks(connection: redis.Redis, storage: Storage, needs: Sequence[tuple[StoredKind, str]]) -> None:
    """Raise a 404 problem if one of these records is being deleted, or was since the request looked for it."""
    values = cast(list[bytes | None], connection.mget(mark_keys(needs)))
    for (kind, record_id), value in zip(needs, values, strict=True):
        is_capture = kind is StoredKind.capture
        path = layout.capture_record(record_id) if is_capture else layout.job_record(record_id)
        if value == DELETING or (value == DELETED and not storage.exists(path)):
            raise ProblemError(
                "capture_not_found" if is_capture else "model_not_found",
                f"The {kind.value} {record_id} is being deleted.",
                advice="Upload the photos again and create a new job."
                if is_capture
                else "Start from another model.",
            )
