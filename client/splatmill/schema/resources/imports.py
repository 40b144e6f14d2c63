"""Imports: files of a capture that the server fetches from an address."""

from enum import StrEnum

from pydantic import Field

from splatmill.schema.base import Request, Response, Time
from splatmill.schema.files.names import FileName
from splatmill.schema.problems import Problem
from splatmill.schema.resources.captures import CaptureFile, Role


class CreateImport(Request):
    """A request to fetch a file of a capture from an address."""

    url: str = Field(min_length=1, max_length=2000, description="Address of the file: http:// or https://.")
    role: Role = Field(default=Role.images, description="Purpose of the file in the capture.")
    name: FileName | None = Field(
        default=None, description="Its name in the capture. Left out, the last part of the address."
    )
    sha256: str | None = Field(
        default=None,
        pattern=r"^[0-9a-fA-F]{64}$",
        description="SHA-256 of its bytes in hex; checked if given.",
    )


class ImportState(StrEnum):
    """Where an import stands."""

    queued = "queued"
    running = "running"
    succeeded = "succeeded"
    failed = "failed"

    @property
    def final(self) -> bool:
        """Whether nothing follows this state."""
        return self in (ImportState.succeeded, ImportState.failed)


class Import(Response):
    """A file that the server fetches, or has fetched."""

    id: str
    capture: str
    url: str
    role: Role
    name: FileName
    sha256: str | None = None
    state: ImportState
    attempts: int = Field(
        default=0, ge=0, description="Number of times that the server has begun to fetch it."
    )
    received: int = Field(default=0, ge=0, description="Bytes received in the present attempt.")
    size: int | None = Field(default=None, description="Announced size in bytes.")
    created_at: Time
    finished_at: Time | None = None
    file: CaptureFile | None = Field(default=None, description="The stored file.")
    problem: Problem | None = Field(default=None, description="Why the import failed.")


class ImportList(Response):
    """The imports of a capture, newest first."""

    imports: list[Import]
