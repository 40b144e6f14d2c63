"""The names of the files of a capture: which are accepted, and how others are changed so that they are."""

import hashlib
import re
import unicodedata
from os.path import splitext
from typing import Annotated
from urllib.parse import unquote

from pydantic import AfterValidator

MAX_NAME_BYTES = 512
MAX_PART_BYTES = 200  # file systems allow 255, and stores append suffixes of their own
MAX_PARTS = 16

# The local store stages an upload as `name#1`, so it would mistake such a name for a staged upload.
_STAGED = re.compile(r"#\d+\Z", re.ASCII)
_DRIVE = re.compile(r"[A-Za-z]:", re.ASCII)


class UnsafeName(ValueError):
    """A file name is not accepted. The message says why, and what to change."""


def safe_name(name: str) -> str:
    """Return the name that a file of a capture is stored under: a relative path with `/`, in Unicode form NFC.

    The name is normalised to NFC, because two encodings of one accent would be two files, and is otherwise unchanged,
    so that clients find their files under the names they gave.

    Raises UnsafeName for an empty or over-long name, an absolute path or a drive, a part that is empty, `.` or `..`,
    a backslash, a control character, a part that begins or ends with a space, and a name that ends in `#` and digits.
    """
    shown = ascii(name if len(name) <= 80 else name[:77] + "...")
    name = unicodedata.normalize("NFC", name)
    if not name:
        raise UnsafeName("A file name is empty; give every file a name.")
    if any(unicodedata.category(char) in ("Cc", "Cs") for char in name):
        raise UnsafeName(f"The file name {shown} contains a control character; rename the file.")
    if "\\" in name:
        raise UnsafeName(f"The file name {shown} contains a backslash; separate folders with '/'.")
    if name.startswith("/") or _DRIVE.match(name):
        raise UnsafeName(f"The file name {shown} is absolute; make it relative to the capture.")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise UnsafeName(f"The file name {shown} is longer than {MAX_NAME_BYTES} bytes; shorten it.")
    parts = name.split("/")
    if len(parts) > MAX_PARTS:
        raise UnsafeName(f"The file name {shown} has {len(parts)} parts; at most {MAX_PARTS} are accepted.")
    for part in parts:
        if part in ("", ".", ".."):
            raise UnsafeName(
                f"The file name {shown} contains the part {part!r}; remove empty, '.' and '..' parts."
            )
        if part != part.strip():
            raise UnsafeName(f"The file name {shown} has a space at an end of {part!r}; rename it.")
        if len(part.encode()) > MAX_PART_BYTES:
            raise UnsafeName(
                f"The file name {shown} has a part of more than {MAX_PART_BYTES} bytes; shorten it."
            )
    if _STAGED.search(name):
        raise UnsafeName(f"The file name {shown} ends in '#' and digits, which is reserved; rename the file.")
    return name


def storable_name(name: str) -> str:
    """Return a name for the file `name` that `safe_name` accepts: its own, or a changed one that no other file gets.

    Backslashes, control characters, bytes that are not UTF-8 and the colon of a drive become `_`, spaces at an end of a
    part are removed, and a part that is too long is shortened. Each changed part ends in a digest of what it was, and
    its suffix. The digest is that of the part without suffix: a photo and its mask keep one stem.

    Raises UnsafeName for what no change of characters mends: an empty part, `.`, `..`, an absolute path, and a path
    with too many parts or bytes.
    """
    try:
        return safe_name(name)
    except UnsafeName:
        parts = unicodedata.normalize("NFC", name).split("/")
        last = len(parts) - 1
        return safe_name("/".join(_mended(part, k == 0, k == last) for k, part in enumerate(parts)))


def _mended(part: str, first: bool, last: bool) -> str:
    """A part of a path as `storable_name` changes it; one that is a name already stays as it is."""
    text = "".join(
        "_" if c in "\\\ufffd" or unicodedata.category(c) in ("Cc", "Cs") else c for c in part
    ).strip()
    if first and _DRIVE.match(text):
        text = f"{text[0]}_{text[2:]}"
    if last and _STAGED.search(text):
        text = text.replace("#", "_")
    if text in ("", ".", "..") or (text == part and len(part.encode()) <= MAX_PART_BYTES):
        return text
    stem, suffix = splitext(text)
    digest = hashlib.sha256(splitext(part)[0].encode("utf-8", "surrogateescape")).hexdigest()[:8]
    room = max(0, MAX_PART_BYTES - len(suffix.encode()) - len(digest) - 1)
    return f"{stem.encode()[:room].decode(errors='ignore').strip()}-{digest}{suffix}"


FileName = Annotated[str, AfterValidator(safe_name)]


def readings(name: str) -> tuple[str, ...]:
    """Return the paths that a name in a file of cameras may stand for, in order of preference.

    Programs write it with the slashes of their system, with `./` in front, or percent-encoded as in addresses.
    """
    plain = name.replace("\\", "/").removeprefix("./")
    return tuple(dict.fromkeys((plain, unquote(plain))))
