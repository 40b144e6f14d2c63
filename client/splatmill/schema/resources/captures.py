"""Captures: the photos, masks and poses that belong together."""

from enum import StrEnum

from pydantic import Field

from splatmill.schema.base import Label, Request, Response, Time
from splatmill.schema.files.names import FileName
from splatmill.schema.resources.access import DEFAULT_OWNER, Owner

SHA256_HEADER = "X-Content-SHA256"
"""Request and response header: SHA-256 of a file's bytes in lower-case hex."""


class Role(StrEnum):
    """The purpose of a file of a capture, and the name of the folder it is stored in."""

    images = "images"
    masks = "masks"
    poses = "poses"


MAY_BE_EMPTY = ("points3D.txt", "points3D.bin")
"""File names, among the poses, of a COLMAP model's points: cameras that were measured come without any."""


def may_be_empty(role: Role, name: str) -> bool:
    """Return whether a file with this name is accepted without bytes."""
    return role is Role.poses and name.rpartition("/")[2] in MAY_BE_EMPTY


class CreateCapture(Request):
    """A request for a new, empty capture. Its files are uploaded one by one afterwards."""

    name: Label | None = Field(default=None, description="A name to recognise the capture by.")
    key: str | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        description="Requests of one owner with the same key get the same capture, with the files that it holds.",
    )


class CaptureFile(Response):
    """One stored file of a capture."""

    role: Role
    name: FileName = Field(description="Relative path with '/', unique within the role.")
    size: int = Field(ge=0, description="Size in bytes.")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the bytes in lower-case hex.")


class Capture(Response):
    """Photos (or a video, or a zip archive), masks and poses that belong together."""

    id: str
    name: str | None = None
    owner: Owner = DEFAULT_OWNER
    created_at: Time
    files: list[CaptureFile] = Field(default_factory=list)


class CapturePage(Response):
    """A page of captures, newest first, without their files."""

    captures: list[Capture]
    cursor: str | None = Field(
        default=None, description="Send it as ?cursor= to get the next page; null on the last page."
    )
