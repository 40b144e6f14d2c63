"""Who may do what: owners of records, keys with their scopes and limits, and what a caller is told about itself."""

from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, Field

from splatmill.schema.base import Duration, Label, Request, Response, Time

DEFAULT_OWNER = "default"
"""The owner of what is made without a key or with SPLATMILL_API_KEY, and of records that name no owner."""

LONGEST_GRACE = 30 * 86400.0
"""Seconds for which the former secret of a key may stay valid after a rotation."""

OWNER_PATTERN = r"^[a-z0-9][a-z0-9._-]{0,63}$"

Owner = Annotated[str, Field(description="Whose record it is.")]


class Scope(StrEnum):
    """What a caller may do.

    read: read its owner's records, and render its owner's models.
    train: what `read` permits; upload photos, start, cancel and restart jobs, and delete its owner's records.
    admin: everything, with the records of all owners.
    metrics: read the metrics of the service, and nothing else.
    """

    read = "read"
    train = "train"
    admin = "admin"
    metrics = "metrics"

    @property
    def permits(self) -> "frozenset[Scope]":
        """The scopes whose requests this one permits."""
        chain = (Scope.read, Scope.train, Scope.admin)
        if self is Scope.admin:
            return frozenset(Scope)
        return frozenset(chain[: chain.index(self) + 1] if self in chain else (self,))


class KeyLimits(Response):
    """The limits of a key. None is no limit."""

    unfinished_jobs: int | None = Field(
        default=None, ge=0, description="Jobs of the owner that may be unfinished at once."
    )
    bytes_stored: int | None = Field(
        default=None, ge=0, description="Bytes that the owner's records may occupy in storage."
    )
    requests_per_minute: int | None = Field(
        default=None, ge=1, description="Requests with this key a minute."
    )


class NewKeyLimits(KeyLimits):
    """The limits of a new key. An unknown limit is an error, so that a misspelt one does not pass as no limit."""

    model_config = ConfigDict(extra="forbid")


class CreateKey(Request):
    """A request for a new key."""

    name: Label = Field(min_length=1, max_length=100, description="What people call the key.")
    owner: str = Field(
        default=DEFAULT_OWNER,
        pattern=OWNER_PATTERN,
        description="To whom belongs what is made with the key. Several keys may have one owner.",
    )
    scopes: list[Scope] = Field(
        default_factory=lambda: [Scope.read, Scope.train],
        min_length=1,
        max_length=len(Scope),
        description="What the key permits.",
    )
    limits: NewKeyLimits = Field(default_factory=NewKeyLimits)


class RotateKey(Request):
    """A request for a new secret of a key."""

    grace: Duration = Field(
        default=0.0,
        ge=0,
        le=LONGEST_GRACE,
        description="For how long the former secret stays valid: seconds, or a text such as 90s, 5m, 1h30m.",
    )


class Key(Response):
    """A key, without its secret."""

    id: str
    name: str
    owner: Owner
    scopes: list[Scope]
    limits: KeyLimits = Field(default_factory=KeyLimits)
    created_at: Time
    rotated_at: Time | None = Field(default=None, description="When the key got its present secret.")
    former_valid_until: Time | None = Field(
        default=None, description="Until when the former secret is valid too."
    )


class KeyWithSecret(Key):
    """A new key, or a key with a new secret."""

    secret: str = Field(description="What clients send as `Authorization: Bearer SECRET`. It is shown once.")


class KeyList(Response):
    """The response of `GET /v1/keys`, the oldest key first."""

    keys: list[Key]


class Use(Response):
    """How much of its limits a caller uses now."""

    unfinished_jobs: int = Field(ge=0, description="Jobs of the owner that have not ended.")


class Me(Response):
    """The response of `GET /v1/me`: who the server takes the caller for, and what it may do."""

    owner: Owner
    key: str | None = Field(default=None, description="Id of the stored key that was used.")
    key_name: str = Field(description="Name of the key, or what was used in place of a stored key.")
    scopes: list[Scope]
    limits: KeyLimits
    use: Use
