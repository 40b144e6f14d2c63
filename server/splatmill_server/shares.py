"""Links to models for people without a key: makes, opens and revokes them.

Nobody finds a link who was not given it, and it shows one model only.

The token is `<model>-<share>-<32 hex digits>`: model and share find its record without a search, and the hex digits are
128 random bits. Only its digest is stored. A link ends when it expires, when it is revoked, and with its model.
"""

import hashlib
import hmac
import json
import re
import secrets
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import redis

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.records import FORMAT, read_record
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import (
    HELD_OUT,
    BinKind,
    CreateShare,
    ModelCameras,
    Response,
    Share,
    SharedModel,
    ShareWithToken,
    Time,
)
from splatmill_server.base.leases import exclusive
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import address
from splatmill_server.models import Models

MAX_SHARES = 100
"""Links to one model that have not ended."""

KEPT_ENDED = timedelta(days=90)
"""Time for which the record of a link that has ended is kept, so that its page can say so."""

_HIDDEN_FILES = frozenset({"job.json", "frame.json", "report.json"})
"""Files of a model that no link gives out: the record names the owner and the options of the job, the frame says where
the photos were taken, and the report for programs names the machine. The page of the report does not."""

_REPORT_PAGE = "report.html"
"""It shows photos, so that it is given out with the held-out photos alone."""

_TOKEN = re.compile(r"([a-z0-9]{8,40})-([0-9a-f]{8})-([0-9a-f]{32})", re.ASCII)


class StoredShare(Response):
    """A link as it is stored.

    sha256: digest of the whole token in hex.
    """

    format: int = FORMAT
    id: str
    model: str
    name: str | None = None
    created_at: Time
    expires_at: Time
    revoked_at: Time | None = None
    photos: bool = False
    sha256: str

    @property
    def active(self) -> bool:
        """Whether the link is neither revoked nor expired."""
        return self.revoked_at is None and datetime.now(UTC) < self.expires_at

    @property
    def ended_at(self) -> Time:
        """When the link ended, or will end."""
        return min(self.revoked_at or self.expires_at, self.expires_at)

    def gives(self, name: str) -> bool:
        """Whether it gives out a file of the model."""
        shows_photos = name == _REPORT_PAGE or name.startswith(f"{HELD_OUT}/")
        return name not in _HIDDEN_FILES and (self.photos or not shows_photos)

    def public(self) -> Share:
        """Return what the owner sees of it."""
        return Share.model_validate(self.model_dump(exclude={"sha256", "format"}) | {"active": self.active})


class Shares:
    """All operations on links. Methods raise ProblemError and StorageError."""

    def __init__(self, storage: Storage, connection: redis.Redis, models: Models) -> None:
        self.storage = storage
        self.connection = connection
        self.models = models

    def create(self, model_id: str, request: CreateShare) -> ShareWithToken:
        """Create a link to a finished model, and forget links to it that ended long ago.

        Links to a model are created one at a time, so that many at once are counted. Raises redis.RedisError.
        """
        self.models.check(model_id)
        with exclusive(self.connection, "shares", model_id):
            return self._create(model_id, request)

    def _create(self, model_id: str, request: CreateShare) -> ShareWithToken:
        now = datetime.now(UTC)
        known = self._stored(model_id)
        if sum(share.active for share in known) >= MAX_SHARES:
            raise ProblemError(
                "too_many_requests",
                f"There are {MAX_SHARES} links to this model, and no more are accepted.",
                advice="Revoke one that is not needed with DELETE /v1/models/{id}/shares/{share}.",
            )
        for share in known:
            if share.ended_at < now - KEPT_ENDED:
                self.storage.delete(layout.share_record(model_id, share.id))
        share_id = secrets.token_hex(4)
        token = f"{model_id}-{share_id}-{secrets.token_hex(16)}"
        share = StoredShare(
            id=share_id,
            model=model_id,
            name=request.name,
            created_at=now,
            expires_at=now + timedelta(seconds=request.expires_in),
            photos=request.photos,
            sha256=_digest(token),
        )
        self._store(share)
        return ShareWithToken(**share.public().model_dump(), token=token, path=address(f"/s/{token}"))

    def list(self, model_id: str) -> list[Share]:
        """Return the links to a model, newest first, those that have ended too."""
        self.models.check(model_id)
        shares = sorted(self._stored(model_id), key=lambda share: (share.created_at, share.id), reverse=True)
        return [share.public() for share in shares]

    def revoke(self, model_id: str, share_id: str) -> None:
        """End a link for good; one that has ended stays as it is. Raises a 404 problem."""
        self.models.check(model_id)
        share = self._load(layout.share_record(model_id, share_id)) if _is_share_id(share_id) else None
        if share is None:
            raise ProblemError(
                "share_not_found",
                f"The model {model_id} has no link {share_id[:80]!r}.",
                advice=f"List its links with GET /v1/models/{model_id}/shares.",
            )
        if share.revoked_at is None:
            self._store(share.model_copy(update={"revoked_at": datetime.now(UTC)}))

    def get(self, token: str) -> StoredShare:
        """Return the link of a token. Raises a 404 problem for none, and a 410 problem for one that has ended."""
        match = _TOKEN.fullmatch(token)
        share = self._load(layout.share_record(match[1], match[2])) if match else None
        if share is None or not hmac.compare_digest(share.sha256.encode(), _digest(token).encode()):
            raise _no_such_link()
        if not share.active:
            verb = "was revoked" if share.revoked_at is not None else "expired"
            raise ProblemError(
                "share_ended",
                f"This shared link {verb} on {share.ended_at:%Y-%m-%d}.",
                advice="Ask whoever sent it for a new one.",
            )
        self.models.check(share.model)
        if self.storage.exists(layout.binned(BinKind.job, share.model)):
            raise _no_such_link()
        return share

    def get_model(self, share: StoredShare) -> SharedModel:
        """Return what somebody with the link may know of the model."""
        model = self.models.get(share.model)
        files = [file for file in model.files if share.gives(file.name)]
        known = model.model_dump(exclude={"files"})
        known |= {"antialias": self.models.antialias(share.model), "expires_at": share.expires_at}
        return SharedModel.model_validate(known | {"files": files})

    def get_cameras(self, share: StoredShare) -> ModelCameras:
        """Return the cameras of the photos; those of a link without photos name no photo that it would not give out."""
        all_cameras = self.models.get_cameras(share.model)
        if share.photos:
            return all_cameras
        cameras = [camera.model_copy(update={"photo": None}) for camera in all_cameras.cameras]
        return all_cameras.model_copy(update={"cameras": cameras})

    def _stored(self, model_id: str) -> Sequence[StoredShare]:
        entries = self.storage.entries(layout.shares_of(model_id))
        return [share for entry in entries if (share := self._load(entry.path)) is not None]

    def _load(self, path: str) -> StoredShare | None:
        """Return a link, or None for one that is missing, or not readable in every part: it opens nothing then."""
        outcome = "the link is not accepted, because it cannot be read"
        return read_record(self.storage, path, StoredShare, outcome)

    def _store(self, share: StoredShare) -> None:
        record = share.model_dump(mode="json", exclude_none=True)
        self.storage.put(layout.share_record(share.model, share.id), json.dumps(record, indent=1).encode())


def _no_such_link() -> ProblemError:
    return ProblemError(
        "share_not_found",
        "There is no such shared link; the model may have been deleted.",
        advice="Check that the address is complete, or ask for a new link.",
    )


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _is_share_id(text: str) -> bool:
    return re.fullmatch(r"[0-9a-f]{8}", text, re.ASCII) is not None
