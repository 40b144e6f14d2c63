"""The names of all keys of Splatmill in Redis. Those of RQ are in `queue.rq_keys`.

The keys of a job are deleted with the job; where keys expire, their functions say so.
"""

PREFIX = "splatmill:"

JOBS = PREFIX + "jobs"
"""Sorted set of job ids, scored by time of creation in milliseconds: the order in which jobs are listed."""

ACTIVE = PREFIX + "active"
"""Set of the ids of unfinished jobs, which the reaper checks. It may still hold jobs that have ended."""

ENDS = PREFIX + "ends"
"""List of jobs whose worker has reported their end, on which API processes wait: each end goes to one of them. Workers
add to it. Where one is lost, the reaper finds the end among `ACTIVE`."""

LISTED = PREFIX + "listed"
"""String that exists while the lists hold all records of storage (see `lists`). Only the server writes it."""

LISTING = PREFIX + "listing"
"""Lock of the API process that makes the lists anew."""

BIN = PREFIX + "bin"
"""Hash of what is in the bin: `<kind>/<id>` to its record. Only the server writes it, after storage."""

RESTORED = PREFIX + "restored"
"""Set of the jobs that were restored from storage and may still have a process that runs them. It expires."""

UNSHRUNK = PREFIX + "whole"
"""Sorted set of ended jobs whose streams still hold all events, scored by the time in milliseconds from which their
log, curve and progress are deleted. These are in storage by then. Only the server writes it."""

WRITABLE = PREFIX + "writable"
"""String that is written to find out whether Redis takes writes; it expires."""

TOTALS = PREFIX + "totals"
"""Hash of what is counted for the whole service (see `totals`), by field."""

REGISTRIES_CHECKED = PREFIX + "queue:tidied"
"""String that exists after a worker has removed stale entries from the registries of RQ, until the next is due."""

PLACES = PREFIX + "queue:places"
"""Hash of the waiting entries: entry to `<line>:<owner>`, the sorted set that holds it."""

TURNS = PREFIX + "queue:turns"
"""Sorted set of owners, scored by the number of the turn in which a worker last took an entry of theirs; 0: never."""

ARRIVED = PREFIX + "queue:arrived"
"""Sorted set of the waiting entries, scored by the time in seconds, by the clock of Redis, since which they wait."""

COUNTERS = PREFIX + "queue:counters"
"""Hash of the last numbers given: `back` and `front` of a line, and `turn`."""


def in_bin(kind: str, record_id: str) -> str:
    """Return the field of a record in the hash `BIN`."""
    return f"{kind}/{record_id}"


def line(name: str, owner: str) -> str:
    """Return the key of the waiting entries of an owner in a line, a sorted set in the order of their turns."""
    return f"{PREFIX}queue:line:{name}:{owner}"


def bell(name: str) -> str:
    """Return the key of a list on which idle workers wait: one element for each entry that has come to the line."""
    return f"{PREFIX}queue:bell:{name}"


def durations(name: str) -> str:
    """Return the key of a list with the seconds that the last attempts of a line took, newest first."""
    return f"{PREFIX}queue:durations:{name}"


def listed(kind: str, group: str, owner: str | None) -> str:
    """Return the key of a list of records (see `lists`): a sorted set of ids, scored by time in milliseconds."""
    return f"{PREFIX}list:{kind}:{group}" + (f":of:{owner}" if owner is not None else "")


def records(kind: str) -> str:
    """Return the key of a hash with what lists show of captures or models, by id. Only the server writes it."""
    return f"{PREFIX}records:{kind}"


def job(job_id: str) -> str:
    """Return the key of the job row, a hash. Only the server writes it."""
    return f"{PREFIX}job:{job_id}"


def states(job_id: str) -> str:
    """Return the key of the stream of states and plans, which is never trimmed. Only workers append."""
    return f"{PREFIX}job:{job_id}:states"


def progress(job_id: str) -> str:
    """Return the key of the stream of progress, previews, cameras and snapshots; trimmed. Only workers append."""
    return f"{PREFIX}job:{job_id}:progress"


def log(job_id: str) -> str:
    """Return the key of the stream of log lines below warnings, which is trimmed. Only workers append."""
    return f"{PREFIX}job:{job_id}:log"


def warnings(job_id: str) -> str:
    """Return the key of the stream of warnings and errors, which is trimmed. Only workers append."""
    return f"{PREFIX}job:{job_id}:warnings"


def curve(job_id: str) -> str:
    """Return the key of the stream of metrics, which is trimmed. Only workers append."""
    return f"{PREFIX}job:{job_id}:curve"


def latest(job_id: str) -> str:
    """Return the key of a hash with the newest entries of some types of events, and what became of the streams.

    Workers write the fields of `events.LATEST`, and the server the field SHRUNK.
    """
    return f"{PREFIX}job:{job_id}:latest"


SHRUNK = "shrunk"
"""Field of `latest`: the job has ended before, and its log and curve from then are in storage alone."""


def attempts(job_id: str) -> str:
    """Return the key of the number of attempts that have begun, over all generations. Only workers count."""
    return f"{PREFIX}job:{job_id}:attempts"


def lock(job_id: str) -> str:
    """Return the key of the lock, a hash with the process that works on the job. Only workers write it."""
    return f"{PREFIX}job:{job_id}:lock"


def watched(job_id: str) -> str:
    """Return the key of a string that exists while somebody watches the scene in training. It expires.

    Only the server writes it, and the worker makes snapshots while it is there.
    """
    return f"{PREFIX}job:{job_id}:watched"


def snapshot(job_id: str) -> str:
    """Return the key of a hash with the newest snapshot of the scene in training, `ply`, and its `tag`. It expires.

    Only workers write it.
    """
    return f"{PREFIX}job:{job_id}:snapshot"


def idempotency(key_digest: str) -> str:
    """Return the key of a string with the job id and the body digest that an `Idempotency-Key` was first used for.

    key_digest: SHA-256 in hex of the owner and the `Idempotency-Key`.
    """
    return f"{PREFIX}idempotency:{key_digest}"


STORED_TOTALS = PREFIX + "stored"
"""Hash with the bytes in `stored` by owner, for all owners that have keys of `stored` or `uploads`. The server writes
the figures; reservations of workers add owners."""

STORED_LIMITS = PREFIX + "stored:limits"
"""Hash with the limit in bytes of the API key that last added to an owner's records, by owner, and under an empty name
that of owners whose key has none. Only the server writes it."""

SCAN = PREFIX + "stored:scan"
"""Hash with the beginning and the end of the last scan of storage, and the number of the last listing."""

SCAN_LOCK = PREFIX + "stored:lock"
"""Lock of the API process that scans storage."""


DELETIONS = PREFIX + "deletions"
"""Hash with the deletions of records that have begun and not ended, by kind and id. Only the server writes it."""


SWEPT = PREFIX + "swept"
"""A string that exists while no API process needs to sweep storage, since one has. It expires."""


def job_of(name: str) -> str | None:
    """Return the id in the name of a key of a job, or None for another key."""
    head = PREFIX + "job:"
    return name.removeprefix(head).partition(":")[0] if name.startswith(head) else None


DELETED = b"deleted"
"""Value of `deleting` once the files are gone."""


def deleting(record: str) -> str:
    """Return the key of a string that says that a record (kind and id) is being deleted, or was. It expires.

    A job is not created if this key says that it could not run. Only the server writes it.
    """
    return f"{PREFIX}deleting:{record}"


def stored(owner: str) -> str:
    """Return the key of a hash with what an owner has in storage, by kind and id. Only the server writes it."""
    return f"{PREFIX}stored:of:{owner}"


def uploads(owner: str) -> str:
    """Return the key of a hash with an owner's reservations, and what was stored and no scan has counted.

    Server and workers write it, by the scripts of `reservations`.
    """
    return f"{PREFIX}stored:uploads:{owner}"


def rate(key_id: str) -> str:
    """Return the key of a string with the time in milliseconds at which an API key may make all its requests again."""
    return f"{PREFIX}rate:{key_id}"


def session(cookie_digest: str) -> str:
    """Return the key of a string with what the cookie of a browser's session stands for; it expires.

    cookie_digest: SHA-256 in hex of the cookie.
    """
    return f"{PREFIX}session:{cookie_digest}"


def begun_jobs(owner: str) -> str:
    """Return the key of the number of jobs of an owner that were created or restarted.

    It is watched while the unfinished jobs of the owner are counted, so that no other begins at the same moment.
    """
    return f"{PREFIX}begun:{owner}"


def of_job(job_id: str) -> tuple[str, ...]:
    """Return all keys of a job, for deletion."""
    streams = states(job_id), progress(job_id), log(job_id), warnings(job_id), curve(job_id)
    return (
        job(job_id),
        *streams,
        latest(job_id),
        attempts(job_id),
        lock(job_id),
        watched(job_id),
        snapshot(job_id),
    )


def lease(kind: str, name: str) -> str:
    """Return the key of a lease, which expires: the API process that holds it works on an import or a delivery."""
    return f"{PREFIX}lease:{kind}:{name}"
