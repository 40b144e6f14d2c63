"""Captures: the photos, masks and poses that were uploaded together, and the rule for their names."""

import re
import unicodedata
from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, Field

from splatmill.schema.base import Request, Response, Time

SHA256_HEADER = "X-Content-SHA256"
"""Request and response header with the lower-case hex SHA-256 of a file's bytes."""

MAX_NAME_BYTES = 512
MAX_PART_BYTES = 200  # file systems allow 255; stores add suffixes of their own
MAX_PARTS = 16

# The local store stages uploads as `name#1`, and takes a name of that form for one of them.
_STAGED = re.compile(r"#\d+\Z", re.ASCII)
_DRIVE = re.compile(r"[A-Za-z]:", re.ASCII)


class UnsafeName(ValueError):
    """A file name that is not accepted; the text says why."""


def safe_name(name: str) -> str:
    """The name a file of a capture is stored under: a relative path with `/`, in Unicode form NFC.

    Nothing is rewritten beyond NFC (two spellings of one accent would be two files), so that a client finds
    its files under the names it gave.

    Raises UnsafeName for an empty or over-long name, an absolute path or drive, `.` or `..` or an empty
    part, a backslash, a control character, a part with blanks at its ends, and an ending of `#` and digits.
    """
    shown = ascii(name if len(name) <= 80 else name[:77] + "...")
    name = unicodedata.normalize("NFC", name)
    if not name:
        raise UnsafeName("A file name is empty; give every file a name.")
    if any(unicodedata.category(char) in ("Cc", "Cs") for char in name):
        raise UnsafeName(f"The file name {shown} holds a control character; rename the file.")
    if "\\" in name:
        raise UnsafeName(f"The file name {shown} holds a backslash; separate folders with '/'.")
    if name.startswith("/") or _DRIVE.match(name):
        raise UnsafeName(f"The file name {shown} is absolute; names are relative to the capture.")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise UnsafeName(f"The file name {shown} is longer than {MAX_NAME_BYTES} bytes; shorten it.")
    parts = name.split("/")
    if len(parts) > MAX_PARTS:
        raise UnsafeName(f"The file name {shown} has more than {MAX_PARTS} levels of folders.")
    for part in parts:
        if part in ("", ".", ".."):
            raise UnsafeName(
                f"The file name {shown} has the part {part!r}; names must not climb or skip folders."
            )
        if part != part.strip():
            raise UnsafeName(f"The file name {shown} has blanks at the ends of {part!r}.")
        if len(part.encode()) > MAX_PART_BYTES:
            raise UnsafeName(f"The file name {shown} has a part over {MAX_PART_BYTES} bytes; shorten it.")
    if _STAGED.search(name):
        raise UnsafeName(f"The file name {shown} ends in '#' and digits, which is reserved; rename it.")
    return name


class Role(StrEnum):
    """What a file of a capture is for; also the folder it is stored in."""

    images = "images"
    masks = "masks"
    poses = "poses"


FileName = Annotated[str, AfterValidator(safe_name)]


class CreateCapture(Request):
    """What starts a capture; its files follow one by one."""

    name: str | None = Field(default=None, max_length=200, description="A name for people.")


class CaptureFile(Response):
    """One stored file of a capture."""

    role: Role
    name: FileName = Field(description="Relative path with '/', unique within the role.")
    size: int = Field(ge=0, description="Bytes.")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="Lower-case hex digest of the bytes.")


class Capture(Response):
    """Photos (or a video, or a zip), masks and poses that belong together."""

    id: str
    name: str | None = None
    created_at: Time
    files: list[CaptureFile] = Field(default_factory=list)


class CapturePage(Response):
    """Captures, newest first; files are left out of a list."""

    captures: list[Capture]
    cursor: str | None = Field(
        default=None, description="Send it back as ?cursor= for the next page; null on the last."
    )
