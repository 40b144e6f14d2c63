"""Cursors of lists: an opaque text that says after which entry the next page begins."""

import base64
import binascii

from splatmill_server.problems import ProblemError

MAX_LIMIT = 200
DEFAULT_LIMIT = 50


def write_cursor(moment: int, entry_id: str) -> str:
    """The cursor after the entry with this time (milliseconds) and id."""
    return base64.urlsafe_b64encode(f"{moment}/{entry_id}".encode()).decode().rstrip("=")


def read_cursor(cursor: str) -> tuple[int, str]:
    """Time and id in a cursor. Raises a 422 problem for a text that is none of ours."""
    try:
        padded = cursor.encode("ascii") + b"=" * (-len(cursor) % 4)
        moment, _, entry_id = (
            base64.b64decode(padded, altchars=b"-_", validate=True).decode("ascii").partition("/")
        )
        if not entry_id:
            raise ValueError(cursor)
        return int(moment), entry_id
    except (ValueError, binascii.Error) as error:
        raise ProblemError(
            "cursor_invalid",
            "The cursor is not one this service gave.",
            advice="Use the 'cursor' of the previous page as it is, or leave it out to begin anew.",
        ) from error
