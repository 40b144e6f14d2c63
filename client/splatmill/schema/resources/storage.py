"""What the service holds in storage: for whom, how much, and what is deleted next."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from splatmill.schema.base import Response, Time


class StoredKind(StrEnum):
    """What a folder of storage holds.

    capture: photos, masks and poses, with the cameras recovered from them.
    job: checkpoints and other files from which a job resumes.
    model: a finished model with its report.
    """

    capture = "capture"
    job = "job"
    model = "model"


class StoredBytes(Response):
    """Bytes in storage by what they are."""

    captures: int = Field(default=0, ge=0, description="Uploaded files.")
    sfm: int = Field(default=0, ge=0, description="Cameras recovered from captures; shared by their jobs.")
    jobs: int = Field(default=0, ge=0, description="Files from which jobs resume.")
    models: int = Field(default=0, ge=0, description="Models and reports.")
    uploads: int = Field(
        default=0, ge=0, description="What was stored since the last scan of storage, and what is reserved."
    )

    @property
    def total(self) -> int:
        """The sum of all kinds."""
        return self.captures + self.sfm + self.jobs + self.models + self.uploads


class OwnerUse(Response):
    """What the records of one owner occupy."""

    owner: str | None = Field(description="Null for what belongs to nobody: records without their owner.")
    bytes: int = Field(ge=0, description="Bytes in storage; the sum of `by_kind`.")
    limit: int | None = Field(default=None, description="Largest number of bytes; null for no limit.")
    by_kind: StoredBytes = Field(default_factory=StoredBytes)
    captures: int = Field(default=0, ge=0, description="Number of captures.")
    models: int = Field(default=0, ge=0, description="Number of models.")


class StoredRecord(Response):
    """A capture, a job's files or a model, with what it occupies."""

    kind: StoredKind
    id: str
    owner: str | None = Field(default=None, description="Null if nothing says whose it is.")
    name: str | None = None
    bytes: int = Field(ge=0)
    files: int = Field(ge=0, description="Number of files in storage.")
    complete: bool = Field(
        default=True, description="False for what a job wrote of a model before it was cancelled or failed."
    )
    last_used: Time = Field(
        description="When a file of it was last written, or a job that uses it was last heard of."
    )
    needed_by: str | None = Field(
        default=None, description="An unfinished job that needs it; it is not deleted before that has ended."
    )
    expires_at: Annotated[
        Time | None, Field(description="When its age is reached; null if no age is set for it.")
    ] = None


class PlannedDeletion(Response):
    """What the next sweep deletes, and why."""

    kind: str = Field(
        description="capture; job, with its model; work, the files from which a job resumes; or orphan, a folder "
        "without a record."
    )
    id: str
    owner: str | None = None
    bytes: int = Field(ge=0)
    reason: str


class StorageUse(Response):
    """The response of `/v1/storage`."""

    scanned_at: Time = Field(description="When storage was last listed. Uploads since then are counted.")
    owners: list[OwnerUse] = Field(description="The caller's own use; for an admin, that of every owner.")
    largest: list[StoredRecord] = Field(
        default_factory=list, description="The largest records, largest first."
    )
    deletions: list[PlannedDeletion] = Field(
        default_factory=list, description="What the next sweep deletes if nothing uses it before."
    )
