"""Room in the owner's quota for what one job stores and unpacks, reserved before it is written (`reservations`)."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress

import redis

from splatmill.backplane import keys, reservations
from splatmill.backplane.reservations import NoRoom
from splatmill_worker.errors import QuotaReached
from splatmill_worker.service.redis_patience import patiently


class Room:
    """The room of one job, as one of its attempts uses it. The server ends the reservation when the job has ended.

    Methods raise QuotaReached.
    """

    def __init__(self, connection: redis.Redis, owner: str, job_id: str) -> None:
        self._connection = connection
        self._owner = owner
        self._job_id = job_id
        self._lock = threading.Lock()  # previews and copies for other machines are stored by two threads
        self._stored: dict[str, int] = {}
        self._unpacked: dict[str, int] = {}

    def store(self, files: Mapping[str, int], may_refuse: bool = True) -> None:
        """Reserve the sizes of files of the job by their names, in place of those that were reserved for them before;
        without `may_refuse`, only count them.

        While Redis cannot be reached nothing is reserved: the state of a job is worth more than a limit, and a later
        scan of storage counts it.
        """
        with self._lock:
            sizes = {**self._stored, **files}
            with suppress(redis.RedisError):
                self._reserve(reservations.job(self._job_id), sum(sizes.values()), limited=may_refuse)
            self._stored = sizes

    def store_all(self, files: Mapping[str, int]) -> None:
        """Reserve the sizes of all files of a model, once Redis can be reached.

        Raises redis.RedisError if that takes longer than PATIENCE.
        """
        with self._lock:
            together = {**self._stored, **files}
            patiently(lambda: self._reserve(reservations.job(self._job_id), sum(together.values())))
            self._stored = together

    def unpack(self, name: str, size: int, may_refuse: bool = True) -> None:
        """Reserve the bytes that a folder takes on this machine's disk; without `may_refuse`, only count them.

        Raises redis.RedisError if Redis cannot be reached for longer than PATIENCE.
        """
        with self._lock:
            sizes = self._unpacked | {name: size}
            field, total = reservations.work(self._job_id), sum(sizes.values())
            patiently(lambda: self._reserve(field, total, limited=may_refuse))
            self._unpacked = sizes

    def release_unpacked(self) -> None:
        """Enter that nothing that was unpacked is left."""
        self._unpacked = {}
        patiently(lambda: leave(self._connection, self._owner, self._job_id, 0))

    @contextmanager
    def of_capture(self, capture_id: str, size: int) -> Iterator[None]:
        """Reserve bytes that are stored with the capture while the context is open."""
        with _named(), reservations.reserved(self._connection, self._owner, size, folder=capture_id):
            yield

    def _reserve(self, field: str, size: int, *, limited: bool = True) -> None:
        limit = reservations.NOTED if limited else None
        with _named():
            reservations.reserve(self._connection, self._owner, field, size, folder=self._job_id, limit=limit)


def leave(connection: redis.Redis, owner: str, job_id: str, size: int) -> None:
    """Enter what a job has left in its folder on this machine's disk; it counts until it is removed."""
    field = reservations.work(job_id)
    reservations.settle(connection, owner, field, folder=job_id, stored=0)
    if size > 0:
        reservations.reserve(connection, owner, field, size, folder=job_id, limit=None)


def is_counted(connection: redis.Redis, owner: str, job_id: str) -> bool:
    """Return whether what a job has left on a worker's disk is counted."""
    return bool(connection.hexists(keys.uploads(owner), reservations.work(job_id)))


@contextmanager
def _named() -> Iterator[None]:
    try:
        yield
    except NoRoom as refused:
        raise QuotaReached(refused.owner, refused.used, refused.limit, refused.size) from None
