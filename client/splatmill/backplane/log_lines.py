"""Log lines of workers and the renderer as JSON, one object a line, with what they belong to.

    {"event": "...", "level": "info", "timestamp": "...", "worker": "...", "job": "...", "attempt": 2, "request": "..."}

The names are those of the API's lines, so that a request can be followed from the one to the other.
"""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal, get_args

LogFormat = Literal["text", "json"]
"""`text`: lines for people. `json`: one object a line."""

_FIELDS = ("worker", "job", "attempt", "request")

_bound: dict[str, str | int] = {}


def parse_format(text: str) -> LogFormat:
    """Return the format of this name. Raises ValueError."""
    for known in get_args(LogFormat):
        if text == known:
            return known  # type: ignore[no-any-return]  # get_args has no types
    raise ValueError(f"{text!r} is neither text nor json")


def bind(**fields: str | int | None) -> None:
    """Add fields to all further lines of this process, and of those that it forks; None takes a field away."""
    for name, value in fields.items():
        if value is None:
            _bound.pop(name, None)
        else:
            _bound[name] = value


class JsonLines(logging.Formatter):
    """Formats a record as a JSON object without line breaks. Fields of a record itself count before the bound ones."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "event": record.getMessage(),
            "level": record.levelname.lower(),
            "timestamp": datetime.fromtimestamp(record.created, UTC).isoformat().replace("+00:00", "Z"),
            "logger": record.name,
        }
        line |= _bound
        line |= {name: getattr(record, name) for name in _FIELDS if hasattr(record, name)}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def configure(chosen: LogFormat) -> None:
    """Write the lines of this process in a format, JSON to standard error. Text is what Python and RQ write anyway."""
    if chosen == "json":
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(JsonLines())
        logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)
        logging.getLogger("splatmill_worker").setLevel(logging.INFO)
