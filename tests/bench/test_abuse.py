"""Proves what the page of `bench abuse` and its line of the README say of rows, and how the hosts behave.

Does not prove that the service stands the abuse: the benchmark measures that, in minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import abuse
import httpx
import pytest
from _abuse.hosts import serving
from _rows import append
from summary import table

ORIGIN = {"machine": "one", "versions": {"python": "3"}, "commit": "abc"}


def row(abused: bool, run: str = "new", **figures: Any) -> dict[str, Any]:
    seconds = dict.fromkeys(abuse.MEASURED, 0.5)
    also = {"limit": 8_000_000, "most_bytes": 7_500_000, "answers": {"edit 201": 3, "edit 507": 4}}
    return {
        **ORIGIN,
        **seconds,
        "run": run,
        "abused": abused,
        "state": "succeeded",
        "stream_ended": True,
        "upload_conflicts": 0,
        **(also if abused else {}),
        **figures,
    }


def test_what_did_not_arrive_counts_as_longer_than_all_else() -> None:
    rows = [row(True, import_s=value) for value in (1.0, None, 3.0)]
    assert abuse.median(rows, "import_s") == 3.0
    assert abuse.shown(abuse.worst(rows, "import_s")) == "over 60 s"
    rows.append(row(True, import_s=None))
    assert abuse.shown(abuse.median(rows, "import_s")) == "over 60 s"


def test_the_page_shows_the_newest_run() -> None:
    rows = [row(False, "old", import_s=9.0), row(True, "old"), row(False), row(True, import_s=None)]
    page = abuse.STUDY.page(rows)
    assert "| import | 0.5 s (0.5 s) | over 60 s (over 60 s) |" in page
    assert "| jobs that succeeded | 1 of 1 | 1 of 1 |" in page
    assert "may store 8.0 MB, and stored 7.5 MB at most" in page
    assert "| edit | 201: 3, 507: 4 |" in page


def test_the_readme_says_what_the_other_owner_met(tmp_path: Path) -> None:
    for each in (row(False), row(True, webhook_s=None)):
        append(tmp_path / "abuse.jsonl", each)
    line = next(line for line in table(tmp_path).splitlines() if "abuses events" in line)
    assert "its job starts after 0.5 s (0.5 s)" in line
    assert "its webhook comes after over 60 s (0.5 s)" in line
    assert "of 8.0 MB that the first may store, it held 7.5 MB at most" in line


def test_hosts_do_what_they_are_for() -> None:
    with serving(b"photo") as host, httpx.Client(base_url=host.url, timeout=1.0, trust_env=False) as http:
        assert http.get("/file").content == b"photo"
        assert http.post("/file", json={"data": {"id": "job"}}).status_code == 204
        assert [body for _, body in host.posts] == [{"data": {"id": "job"}}]
        later = http.get("/later")
        assert (later.status_code, later.headers["Retry-After"]) == (429, "86400")
        with pytest.raises(httpx.ReadTimeout):
            http.post("/hang", json={})
        with http.stream("GET", "/endless") as endless:
            assert "content-length" not in endless.headers
            assert len(next(endless.iter_bytes(50_000))) == 50_000
        with http.stream("GET", "/slow") as slow:
            assert slow.headers["content-length"] == "1000000"
            assert next(slow.iter_raw()) == b"x"
