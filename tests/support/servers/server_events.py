"""Reading a job's server-sent events over a real connection."""

import json
from collections.abc import Iterator
from typing import Any

from splatmill.schema import EventRecord
from tests.support.served_app import ServedApp


def messages(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    """The messages of an event stream as dicts of their fields; comments under the key ''."""
    message: dict[str, str] = {}
    for line in lines:
        if not line:
            if message:
                yield message
            message = {}
        else:
            name, _, value = line.partition(":")
            message[name] = value.removeprefix(" ")


def follow(app: ServedApp, job_id: str, after: str | None = None) -> list[dict[str, Any]]:
    """Every event until the server ends the stream."""
    headers = {"Last-Event-ID": after} if after else {}
    with app.http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers) as answer:
        if answer.status_code == 204:
            return []
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        events = [m for m in messages(answer.iter_lines()) if "data" in m]
    for message in events:
        record = EventRecord.model_validate_json(message["data"])
        assert (record.id, record.event.type) == (message["id"], message["event"])
    return [json.loads(m["data"]) for m in events]


def brief(records: list[dict[str, Any]]) -> list[Any]:
    """Return the state, the number of units done, or else the type of each event."""
    return [e["event"].get("state") or e["event"].get("done") or e["event"]["type"] for e in records]
