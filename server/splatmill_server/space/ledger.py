"""What each owner has in storage, as of the last scan, with what was uploaded and deleted since. Kept in Redis.

Each scan replaces the figures of the last one. In between, uploads are entries of their own, and deletions leave a mark
where a running scan would put the record back. If a process dies between a change of storage and its entry here, the
figures are wrong until the next scan, which corrects them.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, cast

import redis
from pydantic import BaseModel, ConfigDict, ValidationError

from splatmill.backplane import keys
from splatmill.schema import StoredKind
from splatmill_server.space.holdings import Holding

NOBODY = ""
"""In keys of Redis, the owner of what belongs to nobody. No owner has an empty name."""

UPLOAD_SECONDS = 3600.0
"""Seconds after its last sign of life at which an upload counts as broken off."""

Clock = Callable[[], float]
"""Returns the time in seconds since 1970."""


class Upload(BaseModel):
    """An upload that the last scan has not counted, or only in part.

    bytes: its size as announced, or what has arrived if that is more.
    capture: where it goes.
    touched: time of its last sign of life.
    done: time at which it was stored, or None while it arrives.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    bytes: int
    capture: str
    touched: float
    done: float | None = None


@dataclass(frozen=True)
class Account:
    """What one owner has in storage.

    holdings: the folders as of the last scan, without those deleted since.
    uploads: uploads by token.
    """

    holdings: list[Holding]
    uploads: dict[str, Upload]

    @property
    def bytes(self) -> int:
        """Bytes in storage, with those of uploads that still arrive."""
        return sum(held.size for held in self.holdings) + sum(found.bytes for found in self.uploads.values())


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
        return sorted(
            owner.decode() for owner in cast(set[bytes], self.connection.smembers(keys.STORED_OWNERS))
        )

    def account(self, owner: str) -> Account:
        """Return what an owner has in storage."""
        with self.connection.pipeline() as pipe:
            pipe.hgetall(keys.stored(owner))
            pipe.hgetall(keys.uploads(owner))
            stored, uploads = pipe.execute()
        return _account(stored, uploads)

    def last_scan(self) -> ScanTimes | None:
        """Return when the last scan was, or None if Redis knows of none."""
        began, ended = cast(list[bytes | None], self.connection.hmget(keys.SCAN, ["began", "ended"]))
        return ScanTimes(float(began), float(ended)) if began and ended else None

    def publish(self, began: float, holdings: Iterable[Holding]) -> None:
        """Replace the figures by those of a scan that began at `began`, and forget the uploads that it has counted."""
        by_owner: dict[str, dict[str, str]] = {owner: {} for owner in self.owners()}
        for held in holdings:
            owner = NOBODY if held.owner is None else held.owner
            by_owner.setdefault(owner, {})[held.key] = held.model_dump_json(exclude_defaults=True)
        for owner, fields in by_owner.items():
            self._replace(owner, fields, began)
        self.connection.hset(keys.SCAN, mapping={"began": str(began), "ended": str(self.clock())})

    def _replace(self, owner: str, fields: dict[str, str], began: float) -> None:
        name, uploads_name = keys.stored(owner), keys.uploads(owner)

        def apply(pipe: Any) -> None:
            marks = {
                key.decode(): value
                for key, value in pipe.hgetall(name).items()
                if (at := _deleted_at(value)) is not None and at >= began
            }
            uploads = _uploads(pipe.hgetall(uploads_name))
            over = [token for token, found in uploads.items() if _is_over(found, began)]
            kept = {**fields, **marks}
            pipe.multi()
            pipe.delete(name)
            if kept:
                pipe.hset(name, mapping=kept)
            if over:
                pipe.hdel(uploads_name, *over)
            if kept or len(over) < len(uploads):
                pipe.sadd(keys.STORED_OWNERS, owner)
            else:
                pipe.srem(keys.STORED_OWNERS, owner)

        self.connection.transaction(apply, name, uploads_name)

    def put_upload(self, owner: str, token: str, upload: Upload) -> int:
        """Enter an upload, or its new size. Return the bytes that the owner then has in storage."""
        with self.connection.pipeline(transaction=True) as pipe:
            pipe.hset(keys.uploads(owner), token, upload.model_dump_json(exclude_none=True))
            pipe.sadd(keys.STORED_OWNERS, owner)
            pipe.hgetall(keys.stored(owner))
            pipe.hgetall(keys.uploads(owner))
            *_, stored, uploads = pipe.execute()
        return _account(stored, uploads).bytes

    def drop_upload(self, owner: str, token: str) -> None:
        """Remove the entry of an upload that stored nothing."""
        self.connection.hdel(keys.uploads(owner), token)

    def deleted(self, kind: StoredKind, record_id: str, owner: str | None) -> None:
        """Enter that a record was deleted from storage."""
        name = NOBODY if owner is None else owner
        key = Holding(kind=kind, id=record_id).key
        gone = []
        if kind is StoredKind.capture:
            uploads = _uploads(cast(dict[bytes, bytes], self.connection.hgetall(keys.uploads(name))))
            gone = [
                token
                for token, found in uploads.items()
                if found.capture == record_id and found.done is not None
            ]
        with self.connection.pipeline(transaction=True) as pipe:
            pipe.hset(keys.stored(name), key, json.dumps({"deleted_at": self.clock()}))
            if gone:
                pipe.hdel(keys.uploads(name), *gone)
            pipe.execute()


def _account(stored: dict[bytes, bytes], uploads: dict[bytes, bytes]) -> Account:
    holdings = []
    for value in stored.values():
        if _deleted_at(value) is None:
            try:
                holdings.append(Holding.model_validate_json(value))
            except ValidationError:
                continue  # of another version; the next scan replaces it
    return Account(holdings, _uploads(uploads))


def _deleted_at(value: bytes) -> float | None:
    try:
        found = json.loads(value)
    except ValueError:
        return None
    moment = found.get("deleted_at") if isinstance(found, dict) else None
    return float(moment) if isinstance(moment, int | float) else None


def _uploads(fields: dict[bytes, bytes]) -> dict[str, Upload]:
    found = {}
    for token, value in fields.items():
        try:
            found[token.decode()] = Upload.model_validate_json(value)
        except ValidationError:
            found[token.decode()] = Upload(bytes=0, capture="", touched=0.0, done=0.0)
    return found


def _is_over(upload: Upload, began: float) -> bool:
    """Whether a scan that began at `began` has counted an upload, or the upload was broken off."""
    if upload.done is not None:
        return upload.done < began
    return upload.touched < began - UPLOAD_SECONDS
