"""`bench capacity` with few records: every row is measured on the real service, and the table holds them.

Not proved here: seconds and bytes at a hundred thousand records (server/bench/capacity.md has them).
"""

import os
from itertools import islice
from pathlib import Path

import _s3_server
import capacity
import pytest
from _capacity import followers

pytestmark = pytest.mark.slow


def test_every_row_is_measured_and_written(
    redis_url: str, connection: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(followers, "EVENTS", 3)
    origin = {"commit": "c", "machine": "m", "versions": {"python": "3"}}
    rows = [{**row, **origin} for row in capacity.measure(tmp_path, redis_url, 60, 20)]
    pages = [row for row in rows if row["what"] == "page"]
    assert len(pages) == 20
    assert {row["storage"] for row in pages} == {0}
    assert max(row["round_trips"] for row in pages) <= 10
    (followed,) = (row for row in rows if row["what"] == "followers")
    assert (followed["followers"], followed["told_everything"]) == (20, 20)
    text = capacity.STUDY.page(rows)
    assert "| jobs: of an owner |" in text
    assert "20 clients followed one job: 20 were told everything." in text


def test_records_may_lie_in_a_bucket(redis_url: str, connection: object, tmp_path: Path) -> None:
    before = dict(os.environ)
    with _s3_server.running("capacity") as bucket:
        seeding, listing = islice(capacity.measure(tmp_path, redis_url, 12, 0, bucket), 2)
    assert (seeding["storage_in"], listing["storage_in"]) == ("s3", "s3")
    # capture.json of each, the log of each that has ended, and at most two more for each that waits.
    assert listing["storage"] >= 24
    assert not (tmp_path / "storage").exists()
    assert dict(os.environ) == before
