"""Cursors of lists: opaque texts that name the entry after which the next page begins."""

import base64
import binascii

from splatmill.schema.headers import read_integer
from splatmill_server.base.problems import ProblemError

MAX_LIMIT = 200
DEFAULT_LIMIT = 50


def write_cursor(moment: int, entry_id: str) -> str:
    """Return the cursor for the page after the entry with this time in milliseconds and this id."""
    return base64.urlsafe_b64encode(f"{moment}/{entry_id}".encode()).decode().rstrip("=")


def read_cursor(cursor: str) -> tuple[int, str]:
    """Return the time and the id in a cursor. Raises a 422 problem for any other text."""
    try:
        padded = cursor.encode("ascii") + b"=" * (-len(cursor) % 4)
        moment, _, entry_id = (
            base64.b64decode(padded, altchars=b"-_", validate=True).decode("ascii").partition("/")
        )
        milliseconds = read_integer(moment)
        if milliseconds is None or not entry_id:
            raise ValueError(cursor)
        return milliseconds, entry_id
    except (ValueError, binascii.Error) as error:
        raise ProblemError(
            "cursor_invalid",
            "The cursor is not one that this service has issued.",
            advice="Send the 'cursor' of the previous page unchanged, or leave it out for the first page.",
        ) from error
