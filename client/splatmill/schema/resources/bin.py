"""The bin: what was deleted and can be restored for a day."""

from enum import StrEnum

from pydantic import Field

from splatmill.schema.base import Response, Time
from splatmill.schema.resources.access import DEFAULT_OWNER, Owner


class BinKind(StrEnum):
    """What can be in the bin: a job with its model, or a capture with its photos."""

    job = "job"
    capture = "capture"


class Binned(Response):
    """A record in the bin. No list shows it, links to its model open nothing, and its bytes still count."""

    kind: BinKind
    id: str
    name: str | None = None
    owner: Owner = DEFAULT_OWNER
    model: str | None = Field(default=None, description="Id of the model of a job that has one.")
    binned_at: Time
    deleted_at: Time = Field(description="When it is deleted for good.")


class BinList(Response):
    """What is in the bin, the newest first."""

    entries: list[Binned]
