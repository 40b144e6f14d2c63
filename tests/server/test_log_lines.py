"""A line of a worker's log is one JSON object, whatever the message, with what it belongs to.

Not proved here: that workers bind what they do (tests/worker/service/test_rq_worker.py).
"""

import json
import logging
from collections.abc import Iterator

import pytest

from splatmill.backplane import log_lines


@pytest.fixture(autouse=True)
def _nothing_bound() -> Iterator[None]:
    yield
    log_lines.bind(worker=None, job=None, attempt=None, request=None)


def line(message: str, *arguments: object, **more: object) -> dict[str, object]:
    record = logging.LogRecord("splatmill.test", logging.WARNING, __file__, 1, message, arguments, None)
    record.__dict__.update(more)
    text = log_lines.JsonLines().format(record)
    assert "\n" not in text
    fields: dict[str, object] = json.loads(text)
    return fields


def test_a_line_names_what_is_bound_until_it_is_taken_away() -> None:
    log_lines.bind(worker="a-1", job="j", request="r", attempt=2)
    fields = line("of %s\nand %d", "words", 3)
    assert fields["event"] == "of words\nand 3"
    assert (fields["level"], fields["logger"]) == ("warning", "splatmill.test")
    assert [fields[name] for name in ("worker", "job", "attempt", "request")] == ["a-1", "j", 2, "r"]
    log_lines.bind(job=None, attempt=None)
    assert {"job", "attempt"}.isdisjoint(line("idle"))
    assert line("idle", request="of this line alone")["request"] == "of this line alone"


def test_a_traceback_is_a_field() -> None:
    try:
        raise ValueError("two\nlines")
    except ValueError as error:
        fields = line("it failed", exc_info=(type(error), error, error.__traceback__))
    assert str(fields["exception"]).endswith("ValueError: two\nlines")


def test_formats_have_names() -> None:
    assert [log_lines.parse_format(name) for name in ("text", "json")] == ["text", "json"]
    with pytest.raises(ValueError, match="neither text nor json"):
        log_lines.parse_format("xml")
