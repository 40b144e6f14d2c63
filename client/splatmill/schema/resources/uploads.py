"""Uploads in several requests: the header fields of the IETF draft "Resumable Uploads for HTTP".

Integers and Booleans are those of structured fields (RFC 9651): `1024` (`headers.read_integer`), `?0`, `?1`. A value of
another form counts as absent, as the draft asks for.
"""

UPLOAD_COMPLETE = "Upload-Complete"
"""Whether the body of a request ends the file: `?1` or `?0`. In a response, whether the upload is complete."""

UPLOAD_OFFSET = "Upload-Offset"
"""Number of bytes that the server holds; in a PATCH, the position of its body in the file."""

UPLOAD_LENGTH = "Upload-Length"
"""Size of the whole file in bytes."""

UPLOAD_LIMIT = "Upload-Limit"
"""Limits of the server: `max-size` in bytes, and `max-age`, seconds without a byte after which an upload is deleted."""

PARTIAL_UPLOAD = "application/partial-upload"
"""Media type of the body of a PATCH."""


def read_boolean(value: str | None) -> bool | None:
    """Return the value of a header field with a Boolean, or None if it is absent or not one."""
    return {"?0": False, "?1": True}.get((value or "").strip(" "))


def write_boolean(value: bool) -> str:
    """Return a Boolean as the value of a header field."""
    return "?1" if value else "?0"
