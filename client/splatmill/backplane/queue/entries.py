"""The entries of the job queue: RQ's records, and all settings that differ from RQ's defaults.

An entry is one generation of a Splatmill job, and each run of it is an attempt. Where a scene is trained in tiles, its
attempt adds an entry for each, and later for its last steps, which other workers may take. The server does not import
the worker: which function runs an attempt or a tile is decided there.
"""

import redis
from rq import Queue
from rq.job import Job
from rq.serializers import JSONSerializer

TRAIN = "train"
"""The one queue that RQ knows. Entries arrive in its list; `lines` hold those that wait, `leases` those that run."""

ATTEMPT = "splatmill_worker.job.run_attempt"
"""The function name that each entry carries, because RQ requires one, with the job id as its argument. A worker runs
its own attempt function whatever the name says."""

SERIALIZER = JSONSerializer
"""JSON in place of pickle, RQ's default, so that write access to Redis does not allow running code in a worker.
`QueueEntry` serves the same end."""

JOB_TIMEOUT = -1
"""No time limit (RQ's default is 180 s); the option `time_budget` limits the training."""

MAX_RETRIES = 3
"""Number of further attempts when the process of a job dies. A failure that the pipeline reports is not retried."""

WORKER_TTL = 30
"""Seconds after which an idle worker that has disappeared is no longer listed (RQ's default is 420)."""

MAINTENANCE_INTERVAL = 10
"""Seconds between two looks of an idle worker for expired leases (RQ's default is 600)."""

MONITORING_INTERVAL = 5
"""Seconds between the heartbeats of a busy worker, each of which prolongs its lease (RQ's default is 30)."""

HEARTBEAT_SLACK = 10
"""Seconds by which a heartbeat may be late before the attempt counts as lost (RQ's constant is 60). If a machine
dies, its job is requeued when its lease has expired (see `leases`), after at most one more interval of the reaper."""

KEEP_FINISHED = 24 * 3600
"""Seconds for which RQ keeps its record of a finished job. Splatmill's own stays until the job is deleted."""

UNITS_PER_TILE = 5
"""Entries that a scene in tiles may have for each of them: features of a block of photos, matches of a block of pairs,
the mapping of a block of clusters, its training from the coarse model, and its last steps."""

KEEP_TILES = 60
"""Seconds for which RQ keeps its record of a tile that has ended: what the tile made is in storage by then."""


class QueueEntry(Job):
    """RQ's record of one generation of a job, without callbacks, which RQ would import by names found in Redis."""

    success_callback = None
    failure_callback = None
    stopped_callback = None


def open_queue(connection: redis.Redis) -> Queue:
    """Return RQ's queue, with JSON as serializer, `QueueEntry` as job class and no time limit."""
    return Queue(
        TRAIN,
        connection=connection,
        serializer=SERIALIZER,
        job_class=QueueEntry,
        default_timeout=JOB_TIMEOUT,
    )


def rq_id(job_id: str, generation: int) -> str:
    """Return RQ's id of a generation of a job. RQ allows only letters, digits, `_` and `-`."""
    return f"{job_id}-{generation}"


def unit_id(job_id: str, generation: int, tile: int) -> str:
    """Return RQ's id of a unit, from 1 to UNITS_PER_TILE times the tiles, of a generation that is trained in tiles."""
    return f"{rq_id(job_id, generation)}_{tile}"


def split_rq_id(text: str) -> tuple[str, int]:
    """Return the job id and the generation in an id of RQ, also in that of a tile.

    Raises ValueError for an id of another form.
    """
    job_id, _, generation = _whole(text).rpartition("-")
    if not job_id or not generation.isdigit():
        raise ValueError(f"{text!r} is not '<job id>-<generation>'.")
    return job_id, int(generation)


def tile_of(text: str) -> int | None:
    """Return the number of a unit in an id of RQ; None for the id of a generation."""
    return None if _whole(text) == text else int(text.rpartition("_")[2])


def _whole(text: str) -> str:
    """The id of the generation, for the id of one of its tiles."""
    head, _, tile = text.rpartition("_")
    return head if tile.isdigit() and head.rpartition("-")[2].isdigit() else text
