"""Proves that values of header fields are read within bounds, whatever they hold, and that records become ASCII.

Not proved here: which fields are read so (tests/hostile, test_connection).
"""

import json
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest

from splatmill.schema import Edited, EditedView
from splatmill.schema.headers import read_integer, read_retry_after, read_token, write_json

DIGITS = "9" * 5000
HOSTILE = (
    "",
    " ",
    DIGITS,
    "-1",
    "+1",
    "1_0",
    "1.5",
    "1e9",
    "²",
    "٣",
    "nan",
    "inf",
    "0x10",
    "\x00",
    "1\n",
    "9" * 16,
)


@pytest.mark.parametrize("text", HOSTILE)
def test_what_is_no_integer_of_fifteen_digits_counts_as_absent(text: str) -> None:
    assert read_integer(text) is None
    assert read_retry_after(text) is None


def test_integers_and_pauses_are_read() -> None:
    assert [read_integer(text) for text in ("0", " 17 ", "9" * 15, None)] == [0, 17, 10**15 - 1, None]
    assert read_retry_after("120") == 120.0
    assert read_retry_after(format_datetime(datetime.now(UTC) - timedelta(days=1), usegmt=True)) == 0.0
    later = read_retry_after(format_datetime(datetime.now(UTC) + timedelta(seconds=100), usegmt=True))
    assert later is not None
    assert 98 < later <= 100


@pytest.mark.parametrize(
    "text",
    [
        f"Mon, 01 Jan {DIGITS} 00:00:00 GMT",
        "Mon, 01 Jan 0001 00:00:00 +2359",
        "Mon, 01 Jan 2024 00:00:00 +99999999999999999999",
        "Mon, 01 Jan 2024 00:00:00 +9999",
        "Mon, 99 Jan 2024 99:99:99 GMT",
    ],
)
def test_dates_that_python_cannot_hold_raise_nothing(text: str) -> None:
    assert read_retry_after(text) in (None, 0.0)


def test_only_printable_ascii_is_sent_again() -> None:
    assert read_token('"5f-1"') == '"5f-1"'
    assert [read_token(text) for text in (None, "", "é", "a\r\nb", "a\x7f", "a" * 1001)] == [None] * 6


def test_a_record_with_names_in_any_script_fits_into_a_field() -> None:
    names = ["写真.jpg", "🦊.jpg", 'a"b.jpg', "é\u2028.jpg"]
    record = Edited(gaussians_before=2, gaussians=1, views=[EditedView(name=name) for name in names])
    text = write_json(record)
    assert text.isascii()
    assert text.isprintable()
    assert Edited.model_validate_json(text) == record
    assert [view["name"] for view in json.loads(text)["views"]] == names
