"""Values of HTTP header fields: those of others are read within bounds, and those of our own are written in ASCII.

A field with a value of another form counts as absent. Nothing here raises for a text, whatever it holds: Python's own
parsers raise ValueError for numbers of more than 4,300 digits, and OverflowError for some dates.
"""

import json
import re
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

from pydantic import BaseModel

_INTEGER = re.compile(r"[0-9]{1,15}", re.ASCII)
_VISIBLE = re.compile(r"[\x20-\x7e]+", re.ASCII)


def read_integer(value: str | None) -> int | None:
    """Return an integer of at most 15 digits, the bound of structured fields (RFC 9651)."""
    text = (value or "").strip(" ")
    return int(text) if _INTEGER.fullmatch(text) else None


def read_retry_after(value: str | None) -> float | None:
    """Return the seconds to wait that a Retry-After names, as a number or as a date; 0 for a date in the past."""
    seconds = read_integer(value)
    if seconds is not None:
        return float(seconds)
    try:
        moment = parsedate_to_datetime((value or "")[:100])
        aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
        return max((aware - datetime.now(UTC)).total_seconds(), 0.0)
    except (ValueError, OverflowError, TypeError):
        return None


def read_token(value: str | None, longest: int = 1000) -> str | None:
    """Return a text that can be sent again, such as an ETag: printable ASCII of at most `longest` characters."""
    return value if value is not None and len(value) <= longest and _VISIBLE.fullmatch(value) else None


def write_json(record: BaseModel) -> str:
    """Return a record as JSON in ASCII, in which names in any script fit into a header field."""
    return json.dumps(record.model_dump(mode="json"), ensure_ascii=True, allow_nan=False)
