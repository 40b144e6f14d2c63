"""The owner who trains: uploads a capture, follows a job, imports a file and gets a webhook, and how long each took."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from itertools import pairwise
from typing import Any

import httpx

from _abuse.hosts import Host

LONGEST = 60.0
"""Seconds after which an import, a webhook or an upload counts as not arrived, and silence of a stream as its end."""

JOB_LONGEST = 180.0
"""Seconds after which a job counts as not done."""

PIECES, TRICKLE = 3, 8
"""Requests in which one photo is uploaded, and parts of each, a tenth of a second apart, as over a slow line."""

FOLLOWS_AFTER = 2.0
"""Seconds from the start of a job until it is followed, as by somebody who opens its page."""

STEPS = 400

Row = dict[str, Any]


class Trainer:
    """One owner with a key.

    photos: the files of the capture, by their path in it. piecewise: the one that is uploaded in pieces.
    host: serves the file that is imported, and receives webhooks.
    records: ids of all that was made.
    """

    def __init__(self, url: str, key: str, photos: dict[str, bytes], piecewise: str, host: Host) -> None:
        self.http = httpx.Client(
            base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=LONGEST, trust_env=False
        )
        self.photos, self.piecewise, self.host = photos, piecewise, host
        self.records: set[str] = set()
        self._post("/v1/webhooks", {"url": f"{host.url}/file"})

    def run(self) -> Row:
        """Train once. Seconds are None for what did not come within LONGEST."""
        capture = self._capture()
        for path, content in self.photos.items():
            if path != self.piecewise:
                self.http.put(f"/v1/captures/{capture}/{path}", content=content).raise_for_status()
        row = self._upload(capture)
        with ThreadPoolExecutor(1) as pool:
            importing = pool.submit(self._import)
            row |= self._train(capture)
            row |= {"import_s": importing.result()}
        return row

    def _capture(self) -> str:
        made = str(self._post("/v1/captures", {})["id"])
        self.records.add(made)
        return made

    def _post(self, path: str, body: Row) -> Row:
        answer: Row = self.http.post(path, json=body).raise_for_status().json()
        return answer

    def _upload(self, capture: str) -> Row:
        """Send the last photo in pieces, after a 409 from where the server says."""
        content, conflicts, begun = self.photos[self.piecewise], 0, time.monotonic()
        address = f"/v1/captures/{capture}/{self.piecewise}"
        headers = {
            "Upload-Length": str(len(content)),
            "X-Content-SHA256": hashlib.sha256(content).hexdigest(),
        }
        answer = self.http.put(address, headers=headers | {"Upload-Complete": "?0"}).raise_for_status()
        upload, offset, size = answer.headers["Location"], 0, -(-len(content) // PIECES)
        while offset < len(content) and time.monotonic() - begun < LONGEST:
            piece = content[offset : offset + size]
            last = offset + len(piece) == len(content)
            answer = self.http.patch(
                upload,
                content=_slowly(piece),
                headers={
                    "Upload-Offset": str(offset),
                    "Upload-Complete": "?1" if last else "?0",
                    "Content-Type": "application/partial-upload",
                },
            )
            if answer.is_success:
                offset += len(piece)
                continue
            conflicts += 1
            status = self.http.head(upload)
            offset = int(status.headers.get("Upload-Offset", 0)) if status.is_success else 0
        arrived = offset == len(content)
        if not arrived:
            self.http.put(address, content=content).raise_for_status()
        return {"upload_s": time.monotonic() - begun if arrived else None, "upload_conflicts": conflicts}

    def _import(self) -> float | None:
        """Seconds until a file that another server has is in a capture."""
        capture, begun = self._capture(), time.monotonic()
        path = f"/v1/captures/{capture}"
        made = self._post(f"{path}/import", {"url": f"{self.host.url}/file", "name": "fetched.jpg"})

        def ended() -> bool:
            return self.http.get(f"{path}/imports/{made['id']}").json()["state"] in ("succeeded", "failed")

        arrived = _within(LONGEST, ended)
        return time.monotonic() - begun if arrived else None

    def _train(self, capture: str) -> Row:
        asked = {"capture": capture, "options": {"steps": STEPS, "max_gaussians": 3000}}
        job = str(self._post("/v1/jobs", asked)["id"])
        self.records.add(job)
        time.sleep(FOLLOWS_AFTER)
        stream = Stream(self.http, job)
        record: Row = {}

        def over() -> bool:
            nonlocal record
            record = self.http.get(f"/v1/jobs/{job}").json()
            return record["state"] in ("succeeded", "failed", "cancelled")

        done = _within(JOB_LONGEST, over)
        times = stream.end()
        webhook = worked = None
        if done:
            worked = _time(record["finished_at"]) - _time(record["started_at"])
            _within(LONGEST, lambda: self._told(job) is not None)
            told = self._told(job)
            webhook = None if told is None else max(0.0, told - _time(record["finished_at"]))
        else:
            self.http.post(f"/v1/jobs/{job}/cancel")
        waited = (
            _time(record["started_at"]) - _time(record["created_at"]) if record.get("started_at") else None
        )
        return {"state": record["state"], "waiting_s": waited, **times, "job_s": worked, "webhook_s": webhook}

    def _told(self, job: str) -> float | None:
        """The time at which the webhook of a job came."""
        return next((at for at, body in self.host.posts if body["data"]["id"] == job), None)


class Stream:
    """The events of a job, followed by a thread that notes when each came."""

    def __init__(self, http: httpx.Client, job: str) -> None:
        self._times: list[float] = []
        self._ended = threading.Event()
        self._begun = time.monotonic()
        self._http, self._path = http, f"/v1/jobs/{job}/events"
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        try:
            with self._http.stream("GET", self._path, timeout=JOB_LONGEST + LONGEST) as answer:
                for line in answer.iter_lines():
                    if line.startswith("data:"):
                        self._times.append(time.monotonic())
        except httpx.HTTPError:
            return  # it counts as a stream that did not end
        self._ended.set()

    def end(self) -> Row:
        """Seconds until the first event, and the longest between two, when the job is over.

        A stream that does not end soon after has lost the last events: the time until now then counts as silence.
        """
        complete = self._ended.wait(5.0)
        times = list(self._times)
        if not complete:
            times.append(time.monotonic())
        gaps = [after - before for before, after in pairwise(times)]
        return {
            "first_event_s": times[0] - self._begun if self._times else None,
            "longest_gap_s": max(gaps, default=0.0) if self._times else None,
            "events": len(self._times),
            "stream_ended": complete,
        }


def _slowly(content: bytes) -> Iterator[bytes]:
    size = -(-len(content) // TRICKLE)
    for at in range(0, len(content), size):
        time.sleep(0.1)
        yield content[at : at + size]


def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    """Whether the condition comes true in time."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.1)
    return True


def _time(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()
