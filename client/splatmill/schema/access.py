"""Who may do what: owners of records, and the scopes and limits of a caller."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from splatmill.schema.base import Response

DEFAULT_OWNER = "default"
"""The owner of what is made without a key or with SPLATMILL_API_KEY, and of records that name no owner."""

Owner = Annotated[str, Field(description="Whose record it is.")]


class Scope(StrEnum):
    """What a caller may do. Each scope includes those before it.

    read: read its owner's records, and render its owner's models.
    train: upload photos, start, cancel and restart jobs, and delete its owner's records.
    admin: everything, with the records of all owners.
    """

    read = "read"
    train = "train"
    admin = "admin"


class KeyLimits(Response):
    """The limits of a caller. None is no limit."""

    unfinished_jobs: int | None = Field(
        default=None, ge=0, description="Jobs of the owner that may be unfinished at once."
    )
    bytes_stored: int | None = Field(
        default=None, ge=0, description="Bytes that the owner's records may occupy in storage."
    )
    requests_per_minute: int | None = Field(default=None, ge=1, description="Requests a minute.")
