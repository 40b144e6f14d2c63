"""The keys of the API: makes, finds, rotates and revokes them.

They are stored hashed in storage, one file a key; no other code writes there.

A secret is `smk_<id>_<64 hex digits>`: the beginning makes a leaked secret recognisable, the id finds its record
without a search. The hex digits are 256 random bits, so a plain SHA-256 protects them: the slow hashes that protect
passwords are needed for texts that can be guessed, and nobody can try 2**256.
"""

import asyncio
import hashlib
import hmac
import json
import re
import secrets
import threading
import time
from datetime import UTC, datetime, timedelta

import redis
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.errors import StorageBusyError, StorageStalledError
from splatmill.backplane.storage.records import FORMAT, read_record
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import CreateKey, Key, KeyWithSecret, Scope, Time
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError

CACHE_SECONDS = 2.0
"""Seconds after which every API process knows of a change to the keys, and so the longest life of a revoked key."""

STALLED_SECONDS = 60.0
"""Seconds for which the last copy of the keys counts while storage does not answer. Then no key is accepted."""

_WAIT = 1.0
"""Seconds that requests wait for a reading of the keys, while there is a copy that counts."""

_NO_ANSWER = (StorageStalledError, StorageBusyError)

_SECRET = re.compile(r"smk_([0-9a-f]{16})_[0-9a-f]{64}", re.ASCII)


class StoredSecret(BaseModel):
    """A secret of a key.

    sha256: digest of the whole secret in hex.
    until: when it stops being valid; None for the present secret.
    """

    sha256: str
    until: Time | None = None


class StoredKey(Key):
    """A key with the digests of its secrets."""

    secrets: list[StoredSecret]

    def accepts(self, digest: str) -> bool:
        """Return whether a secret with this SHA-256 is one of the key's at this moment. Takes constant time."""
        now = datetime.now(UTC)
        valid = [held.sha256 for held in self.secrets if held.until is None or now < held.until]
        # Every digest is compared, so that the time is no hint at which one matched.
        return sum(hmac.compare_digest(digest.encode(), one.encode()) for one in valid) > 0

    def public(self) -> Key:
        """Return what clients see of the key."""
        fields = self.model_dump(exclude={"secrets"})
        former = max((held.until for held in self.secrets if held.until is not None), default=None)
        fields["former_valid_until"] = former if former is not None and former > datetime.now(UTC) else None
        return Key.model_validate(fields)


class Keys:
    """All operations on keys. The records in storage are the truth, of which every process keeps a copy for a moment.

    connection: Redis, for the lease under which the key of an admin is revoked.
    bootstrap: whether the server has SPLATMILL_API_KEY, which is an admin's key that is not stored.
    """

    def __init__(self, storage: Storage, connection: redis.Redis, *, bootstrap: bool) -> None:
        self.storage = storage
        self.connection = connection
        self.bootstrap = bootstrap
        self._lock = threading.Lock()
        self._reading: asyncio.Task[None] | None = None
        self._began = float("-inf")
        self._read_at = float("-inf")
        self._known: dict[str, tuple[str, StoredKey | None]] = {}

    async def current(self) -> None:
        """Read the keys again if the copy is older than CACHE_SECONDS, and raise StorageError where that fails.

        While storage does not answer, the copy counts for STALLED_SECONDS: jobs are listed and cancelled without
        storage.
        """
        if not self._stale():
            return
        if self._reading is None or self._reading.done():
            self._began = time.monotonic()
            self._reading = asyncio.create_task(run_in_threadpool(self.read))
            # Nobody may wait for it any more when it fails.
            self._reading.add_done_callback(lambda task: task.cancelled() or task.exception())
        counts_for = self._read_at + STALLED_SECONDS - time.monotonic()
        wait = max(0.0, self._began + _WAIT - time.monotonic()) if counts_for > 0 else None
        done, _ = await asyncio.wait({self._reading}, timeout=wait)
        for ended in done:
            error = ended.exception()
            if error is not None and not (counts_for > 0 and isinstance(error, _NO_ANSWER)):
                raise error

    def _stale(self) -> bool:
        return time.monotonic() - self._read_at > CACHE_SECONDS

    def read(self) -> None:
        """Read the keys that were changed since the last time. Raises StorageError."""
        with self._lock:
            began = time.monotonic()
            entries = {entry.path: entry.etag for entry in self.storage.entries(layout.keys())}
            known: dict[str, tuple[str, StoredKey | None]] = {}
            for path, etag in entries.items():
                key_id = path.rsplit("/", 1)[-1].removesuffix(".json")
                if path != layout.key_record(key_id) or layout.key_revocation(key_id) in entries:
                    continue
                before = self._known.get(key_id)
                known[key_id] = (
                    before if before is not None and before[0] == etag else (etag, self._load(key_id))
                )
            self._known = known
            self._read_at = began

    def any(self) -> bool:
        """Return whether there are keys, readable or not, as of the last reading."""
        return bool(self._known)

    def get_by_secret(self, secret: str) -> StoredKey | None:
        """Return the key that a secret belongs to, as of the last reading, or None."""
        match = _SECRET.fullmatch(secret)
        return self.get_if_valid(match[1], digest(secret)) if match else None

    def get_if_valid(self, key_id: str, sha256: str) -> StoredKey | None:
        """Return the key with this id if a secret with this digest is valid, as of the last reading, or None."""
        _, key = self._known.get(key_id, ("", None))
        return key if key is not None and key.accepts(sha256) else None

    def list(self) -> list[Key]:
        """Return all keys, the oldest first."""
        self.read()
        keys = [key for _, key in self._known.values() if key is not None]
        return [key.public() for key in sorted(keys, key=lambda key: (key.created_at, key.id))]

    def get(self, key_id: str) -> StoredKey:
        """Return a key. Raises a 404 problem."""
        self.read()
        _, key = self._known.get(key_id, ("", None))
        if key is None:
            raise ProblemError(
                "key_not_found",
                f"There is no key {key_id[:80]!r}.",
                advice="List the keys with GET /v1/keys.",
            )
        return key

    def create(self, request: CreateKey) -> KeyWithSecret:
        """Create a key. Raises a 409 problem if there would be keys, but none of an admin."""
        self.read()
        if Scope.admin not in request.scopes and not self._admin_besides(None):
            raise ProblemError(
                "admin_key_needed",
                "The first key must have the scope admin: with it, the server asks for a key, and nobody else could "
                "make or revoke keys.",
                advice="Create a key with the scope admin first, or start the server with SPLATMILL_API_KEY.",
            )
        key_id = secrets.token_hex(8)
        secret = _new_secret(key_id)
        key = StoredKey(
            id=key_id,
            name=request.name,
            owner=request.owner,
            scopes=[scope for scope in Scope if scope in request.scopes],
            limits=request.limits,
            created_at=datetime.now(UTC),
            secrets=[StoredSecret(sha256=digest(secret))],
        )
        self._store(key)
        return _shown_once(key, secret)

    def rotate(self, key_id: str, grace: float) -> KeyWithSecret:
        """Give a key a new secret; the present one stays valid for `grace` seconds. Raises a 404 problem.

        Of two rotations at once, the later one counts: the secret of the other is not valid.
        """
        key = self.get(key_id)
        now = datetime.now(UTC)
        until = now + timedelta(seconds=grace)
        former = [held.model_copy(update={"until": min(held.until or until, until)}) for held in key.secrets]
        secret = _new_secret(key_id)
        valid = [held for held in former if held.until is not None and held.until > now]
        changed = key.model_copy(
            update={"rotated_at": now, "secrets": [StoredSecret(sha256=digest(secret)), *valid]}
        )
        self._store(changed)
        return _shown_once(changed, secret)

    def revoke(self, key_id: str) -> None:
        """Revoke a key for good. Raises a 404 problem, and a 409 problem for the last key of an admin.

        The revocation is a file of its own, which counts more than the record: a rotation at the same moment, which
        writes the record again, does not bring the key back.

        Keys of admins are revoked one at a time, which needs Redis: of the last two, one is left. Raises
        redis.RedisError. Other keys can be revoked without Redis.
        """
        key = self.get(key_id)
        if Scope.admin not in key.scopes or self.bootstrap:
            self._revoke(key)
            return
        with exclusive(self.connection, "keys", "admin") as keep:
            key = self.get(key_id)
            if not self._admin_besides(key_id):
                raise ProblemError(
                    "admin_key_needed",
                    f"{key.name!r} is the last key with the scope admin; without it, nobody could make or revoke keys.",
                    advice="Create another key with the scope admin first, or start the server with SPLATMILL_API_KEY.",
                )
            keep()  # storage may have taken long to list the keys
            self._revoke(key)

    def _revoke(self, key: StoredKey) -> None:
        revoked = {
            "id": key.id,
            "name": key.name,
            "owner": key.owner,
            "revoked_at": datetime.now(UTC).isoformat(),
        }
        self.storage.put(layout.key_revocation(key.id), json.dumps(revoked | {"format": FORMAT}).encode())
        self.storage.delete(layout.key_record(key.id))
        self.read()

    def _admin_besides(self, key_id: str | None) -> bool:
        """Return whether an admin's key is left without the key `key_id`."""
        others = (key for other_id, (_, key) in self._known.items() if other_id != key_id)
        return self.bootstrap or any(key is not None and Scope.admin in key.scopes for key in others)

    def _store(self, key: StoredKey) -> None:
        record = key.model_dump(mode="json", exclude_none=True) | {"format": FORMAT}
        self.storage.put(layout.key_record(key.id), json.dumps(record, indent=1).encode())
        self.read()

    def _load(self, key_id: str) -> StoredKey | None:
        """Return the key of a record, or None for one that is not readable in every part: no limit may get lost."""
        outcome = "the key is not accepted, because it cannot be read"
        key = read_record(self.storage, layout.key_record(key_id), StoredKey, outcome)
        return key if key is not None and key.id == key_id else None


def digest(secret: str) -> str:
    """Return the SHA-256 of a secret in hex."""
    return hashlib.sha256(secret.encode()).hexdigest()


def _new_secret(key_id: str) -> str:
    return f"smk_{key_id}_{secrets.token_hex(32)}"


def _shown_once(key: StoredKey, secret: str) -> KeyWithSecret:
    return KeyWithSecret(**key.public().model_dump(), secret=secret)
