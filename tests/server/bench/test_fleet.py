"""`bench fleet` with three workers: they end jobs and train by the worker's own code, and its pages hold the rows.

Proved of the numbers: round trips do not grow with the number of workers where they must not. Not proved here: seconds,
and what a thousand workers cost (server/bench/fleet.md has it).
"""

import json
from pathlib import Path

import fleet
import pytest
from _fleet import sizing
from _rows import append, lines

from tests.support.redis_server import empty_redis

pytestmark = pytest.mark.slow


def test_every_row_is_measured_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "PROCESSES", 1)
    monkeypatch.setattr("_fleet.api.LOOK_SECONDS", 0.2)
    (tmp_path / "redis").mkdir()
    with empty_redis(tmp_path / "redis") as url:
        rows = list(fleet.measure(tmp_path, url, workers=3, jobs=6, seconds=2.0))
    start, idle, rate, training = rows
    assert [row["what"] for row in rows] == ["start", "idle", "rate", "training"]
    assert 1 <= start["connections"] <= 2  # the second one listens for commands, and comes a moment later
    assert idle["events"] == 0
    assert rate["jobs"] == 6
    assert rate["storage"]["retire"] >= 1
    assert rate["kept_bytes"] < rate["bytes"]
    # An event is one round trip; beside them there are looks for onlookers and heartbeats.
    assert 0 < training["events"] < training["round_trips"]
    assert training["page"]["found"] == 3
    origin = {"commit": "c", "machine": "m", "versions": {"python": "3"}}
    for row in rows:
        append(tmp_path / "fleet.jsonl", {**row, **origin})
    append(tmp_path / "capacity.jsonl", {"records": 100, "what": "memory", "bytes": 780_000, **origin})
    assert "| 3 | 6 | " in fleet.STUDY.page(lines(tmp_path / "fleet.jsonl"))
    sizing.write_sizing(tmp_path / "fleet.jsonl", tmp_path / "capacity.jsonl", tmp_path / "sizing.md")
    written = (tmp_path / "sizing.md").read_text()
    assert "| ended job, with its capture and model | 7.8 kB of Redis | 100 records |" in written
    assert "| jobs a day (J) | W × 1 day / 10 min | 1,440 | 14,400 | 144,000 | 1,000,000 |" in written
    assert json.loads((tmp_path / "fleet.jsonl").read_text().splitlines()[0])["workers"] == 3
