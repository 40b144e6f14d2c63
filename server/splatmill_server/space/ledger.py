"""What each owner has in storage, as of the last scan, with what was uploaded and deleted since. Kept in Redis.

Each scan replaces the figures of the last one. In between, what is stored is entered as reservations
(`splatmill.backplane.reservations`), and deletions leave a mark where a running scan would put the record back. A file
that is stored just while its folder is listed may count twice until the next scan. If a process dies between a change
of storage and its entry here, the figures are too large until the next scan, which corrects them.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import redis
from pydantic import BaseModel, ConfigDict, ValidationError

from splatmill.backplane import keys, reservations
from splatmill.backplane.reservations import ARRIVING, JOB, STORED, UPLOAD_SECONDS, WORK
from splatmill.schema import StoredKind
from splatmill_server.space.holdings import Holding

NOBODY = ""
"""In keys of Redis, the owner of what belongs to nobody. No owner has an empty name."""

Clock = Callable[[], float]
"""Returns the time in seconds since 1970."""


class Upload(BaseModel):
    """A reservation: of an upload that arrives, or of other bytes that are to be stored.

    bytes: its size as announced, or what has arrived if that is more.
    capture: id of the record that it goes to.
    touched: time of its last sign of life.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    bytes: int
    capture: str
    touched: float


@dataclass(frozen=True)
class Account:
    """What one owner has in storage.

    holdings: the folders as of the last scan, without those deleted since.
    uploads: bytes of reservations, and of what was stored and no scan has counted.
    """

    holdings: list[Holding]
    uploads: int

    @property
    def bytes(self) -> int:
        """Bytes in storage, with those that are reserved."""
        return sum(held.size for held in self.holdings) + self.uploads


@dataclass(frozen=True)
class ScanTimes:
    """When the last scan began and ended, in seconds since 1970."""

    began: float
    ended: float


class Ledger:
    """Reads and writes the figures. Methods raise redis.RedisError if Redis cannot be reached."""

    def __init__(self, connection: redis.Redis, clock: Clock | None = None) -> None:
        self.connection = connection
        self.clock = clock or self._redis_time

    def _redis_time(self) -> float:
        # One clock for all API processes.
        seconds, microseconds = self.connection.time()
        return seconds + microseconds / 1e6

    def owners(self) -> list[str]:
        """Return the owners that have something in storage, sorted; NOBODY among them."""
        names = cast(list[bytes], self.connection.hkeys(keys.STORED_TOTALS))
        return sorted(owner.decode() for owner in names)

    def account(self, owner: str) -> Account:
        """Return what an owner has in storage."""
        with self.connection.pipeline() as pipe:
            pipe.hvals(keys.stored(owner))
            pipe.hgetall(keys.uploads(owner))
            stored, uploads = pipe.execute()
        held = [holding for value in stored if (holding := _holding(value)) is not None]
        return Account(held, _bytes_of(uploads, held))

    def bytes_of(self, owner: str) -> int:
        """Return the bytes that an owner has in storage, with those that are reserved."""
        return reservations.used(self.connection, owner)

    def last_scan(self) -> ScanTimes | None:
        """Return when the last scan was, or None if Redis knows of none."""
        began, ended = cast(list[bytes | None], self.connection.hmget(keys.SCAN, ["began", "ended"]))
        return ScanTimes(float(began), float(ended)) if began and ended else None

    def note_limits(self, owner: str, limit: int | None, everybody: int | None) -> None:
        """Note the limit of the key that adds to an owner's records, and that of owners whose key has none.

        They hold for what is stored without a caller, also by workers.
        """
        reservations.note_limit(self.connection, owner, limit)
        reservations.note_limit(self.connection, reservations.EVERYBODY, everybody)

    def noted_limit(self, owner: str) -> int | None:
        """Return the limit that was noted last for an owner, or None."""
        noted = cast(bytes | None, self.connection.hget(keys.STORED_LIMITS, owner))
        return int(noted) if noted is not None and noted.isdigit() else None

    def begin_listing(self) -> int:
        """Enter that storage is listed from here on, and return the number of the listing.

        Uploads that end before the next listing begins are summed under the number of this one.
        """
        return self.connection.hincrby(keys.SCAN, "listing", 1)

    def stored_since(self, listing: int) -> set[str]:
        """Return the captures, jobs and models that files were stored in since a listing began."""
        stored = set()
        for owner in self.owners():
            for field in cast(list[bytes], self.connection.hkeys(keys.uploads(owner))):
                kind, record, number = [*field.decode().split("/"), ""][:3]
                if kind == STORED and number.isdigit() and int(number) >= listing:
                    stored.add(record)
        return stored

    def publish(
        self, began: float, listing: int, holdings: Iterable[Holding], jobs: Mapping[str, bool] | None = None
    ) -> None:
        """Replace the figures by those of a scan that began at `began`.

        listing: what was stored before this listing began is among `holdings`, and its entries are forgotten.
        jobs: for each job that was known when the scan began, whether it was unfinished. Reservations of others are
        forgotten, and of jobs that had ended those for what they store.
        """
        by_owner: dict[str, dict[str, Holding]] = {owner: {} for owner in self.owners()}
        for held in holdings:
            by_owner.setdefault(NOBODY if held.owner is None else held.owner, {})[held.key] = held
        for owner, held_by_key in by_owner.items():
            self._replace(owner, held_by_key, began, listing, jobs or {})
        self.connection.hset(keys.SCAN, mapping={"began": str(began), "ended": str(self.clock())})

    def _replace(
        self,
        owner: str,
        holdings: Mapping[str, Holding],
        began: float,
        listing: int,
        jobs: Mapping[str, bool],
    ) -> None:
        name, uploads_name = keys.stored(owner), keys.uploads(owner)

        def apply(pipe: Any) -> None:
            marks = {
                key.decode(): value
                for key, value in pipe.hgetall(name).items()
                if (at := _deleted_at(value)) is not None and at >= began
            }
            uploads = pipe.hgetall(uploads_name)
            over = [
                field
                for field, value in uploads.items()
                if _is_over(field.decode(), value, began, listing, jobs)
            ]
            kept = {key: held for key, held in holdings.items() if key not in marks}
            fields = {key: held.model_dump_json(exclude_defaults=True) for key, held in kept.items()} | marks
            pipe.multi()
            pipe.delete(name)
            if fields:
                pipe.hset(name, mapping=fields)
            if over:
                pipe.hdel(uploads_name, *over)
            if fields or len(over) < len(uploads):
                pipe.hset(keys.STORED_TOTALS, owner, sum(held.size for held in kept.values()))
            else:
                pipe.hdel(keys.STORED_TOTALS, owner)

        self.connection.transaction(apply, name, uploads_name)

    def reserve(
        self, owner: str, field: str, size: int, record_id: str, limit: int | None, *, beyond: bool = False
    ) -> None:
        """Do as `reservations.reserve`, by this ledger's clock. Raises its NoRoom."""
        reservations.reserve(
            self.connection,
            owner,
            field,
            size,
            folder=record_id,
            limit=limit,
            beyond=beyond,
            now=self.clock(),
        )

    def settle(self, owner: str, field: str, record_id: str, stored: int) -> None:
        """Enter that a reservation has ended, and that `stored` of its bytes are in storage."""
        reservations.settle(self.connection, owner, field, folder=record_id, stored=stored)

    def is_reserved(self, owner: str, field: str) -> bool:
        """Return whether there is a reservation."""
        return bool(self.connection.hexists(keys.uploads(owner), field))

    def arriving(self, owner: str, capture: str, now: float) -> bool:
        """Return whether an upload to a capture arrives, as far as is known."""
        for field, value in cast(dict[bytes, bytes], self.connection.hgetall(keys.uploads(owner))).items():
            upload = _upload(value) if field.decode().startswith(ARRIVING) else None
            if upload is not None and upload.capture == capture and upload.touched > now - UPLOAD_SECONDS:
                return True
        return False

    def deleted(self, kind: StoredKind, record_id: str, owner: str | None) -> None:
        """Enter that a record was deleted from storage."""
        name = NOBODY if owner is None else owner
        key, stored, uploads = (
            Holding(kind=kind, id=record_id).key,
            keys.stored(name),
            keys.uploads(name),
        )
        mark = json.dumps({"deleted_at": self.clock()})

        def apply(pipe: Any) -> None:
            before = _holding(pipe.hget(stored, key) or b"")
            if kind is StoredKind.job:
                gone = [reservations.job(record_id), reservations.work(record_id)]
            else:  # what is stored of a job and of its model is entered under one id
                gone = [
                    field
                    for field in pipe.hkeys(uploads)
                    if field.decode().startswith(f"{STORED}/{record_id}/")
                ]
            pipe.multi()
            pipe.hset(stored, key, mark)
            pipe.hincrby(keys.STORED_TOTALS, name, -before.size if before is not None else 0)
            if gone:
                pipe.hdel(uploads, *gone)

        self.connection.transaction(apply, stored, uploads)


def _holding(value: bytes) -> Holding | None:
    """Return a stored folder, or None for a mark, or for a value of another version, which the next scan replaces."""
    try:
        return Holding.model_validate_json(value)
    except ValidationError:
        return None


def _deleted_at(value: bytes) -> float | None:
    try:
        mark = json.loads(value)
    except ValueError:
        return None
    moment = mark.get("deleted_at") if isinstance(mark, dict) else None
    return float(moment) if isinstance(moment, int | float) else None


def _upload(value: bytes) -> Upload | None:
    try:
        return Upload.model_validate_json(value)
    except ValidationError:
        return None


def _bytes_of(uploads: Mapping[bytes, bytes], held: Iterable[Holding]) -> int:
    """The bytes of entries, as the scripts of `reservations` sum them."""
    sizes = {holding.key: holding.size for holding in held}
    total = 0
    for field, value in uploads.items():
        kind, _, rest = field.decode().partition("/")
        if kind == STORED:
            total += int(value) if value.isdigit() else 0
        elif (upload := _upload(value)) is not None:
            counted = sum(sizes.get(f"{of}/{rest}", 0) for of in ("job", "model")) if kind == JOB else 0
            total += max(0, upload.bytes - counted)
    return total


def _is_over(field: str, value: bytes, began: float, listing: int, jobs: Mapping[str, bool]) -> bool:
    """Whether a scan has counted an entry, or whoever made it has gone without an end of it."""
    kind, _, rest = field.partition("/")
    upload = _upload(value)
    if kind == ARRIVING:
        return upload is None or upload.touched < began - UPLOAD_SECONDS
    if kind in (JOB, WORK):
        needed = rest in jobs if kind == WORK else jobs.get(rest, False)
        return upload is None or (not needed and upload.touched < began)
    number = rest.rpartition("/")[2]
    return not number.isdigit() or int(number) < listing
