"""The clients of a soak: they upload, start jobs, follow, cancel, look at models, and note what was broken to them."""

import json
import random
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import httpx

from _soak.pipeline import SCRIPT
from _soak.service import Service

FINAL = {"succeeded", "failed", "cancelled"}

UNFINISHED = 3
"""Jobs that are unfinished at each moment, so that a fault always meets work."""

FORGOTTEN_SECONDS = 30.0
"""Seconds after which a job that the service does not know counts as lost."""

CAUSES = {
    "storage_full": "disk",
    "worker_disk_full": "disk",
    "storage_unavailable": "S3",
    "queue_unavailable": "Redis",
}
"""Codes of failures that tell a client to restart the job, and what the name of the fault that may cause it holds."""

_CAUSE_SECONDS = 60.0
"""Seconds after a fault in which a job may fail of it: attempts are repeated first."""

_PAUSE = 0.1  # seconds between two rounds

CAMERA = {
    "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -4], [0, 0, 0, 1]],
    "fov_y_deg": 60,
    "width": 64,
    "height": 48,
}


@dataclass
class Promise:
    """A job that the service has accepted.

    capture: the capture, and `files` the bytes that were uploaded to it.
    state: the last that was seen.
    cancel: whether a client cancels it.
    restarts: how often a client restarted it after a failure whose advice that is.
    restarted_at: monotonic time of the last restart: before it, the job had ended.
    missing_since: monotonic time since when the service says that there is no such job.
    """

    job: str
    capture: str
    files: dict[str, bytes]
    cancel: bool = False
    state: str = "queued"
    restarts: int = 0
    restarted_at: float = 0.0
    asked_to_cancel: bool = False
    missing_since: float | None = None
    failure: str | None = None


@dataclass
class Clients:
    """Clients with a seed, in a thread.

    photos: files of captures that are trained by the engine; every `photo_share`-th job is one of these.
    complaints: what no client should have met.
    captures: those that the service has accepted.
    faults: names of the faults so far, and the monotonic time at which each was over; infinity: it goes on.
    """

    service: Service
    seed: int
    photos: dict[str, bytes] = field(default_factory=dict)
    photo_share: int = 16
    promises: dict[str, Promise] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)
    captures: list[str] = field(default_factory=list)
    faults: list[tuple[str, float]] = field(default_factory=list)
    views: int = 0
    retries: int = 0
    number: int = 0

    def __post_init__(self) -> None:
        self._submitting = threading.Event()
        self._submitting.set()
        self._submission = threading.Lock()
        self._random = random.Random(self.seed)
        self._stop = threading.Event()
        self._http = httpx.Client(base_url=self.service.http.base_url, timeout=15, trust_env=False)
        self._thread = threading.Thread(target=self._run, name="clients", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def submit_no_more(self) -> None:
        """Finish the submission that is under way, and begin no other."""
        self._submitting.clear()
        with self._submission:
            pass

    def stop(self) -> None:
        """Submit and look no more."""
        self._stop.set()
        self._thread.join(60)
        self._http.close()

    def unfinished(self) -> list[Promise]:
        return [promise for promise in list(self.promises.values()) if promise.state not in FINAL]

    def _run(self) -> None:
        while not self._stop.wait(_PAUSE):
            try:
                with self._submission:
                    if self._submitting.is_set() and len(self.unfinished()) < UNFINISHED:
                        self._submit()
                for promise in self.unfinished():
                    self._look(promise)
            except Exception as error:  # a client that stops would end the proof in silence
                self.complaints.append(f"a client met {type(error).__name__}: {error}")

    def _submit(self) -> None:
        self.number += 1
        engine = bool(self.photos) and self.number % self.photo_share == 0
        made = self._ask("POST", "/v1/captures", json={})
        if made is None:
            return
        capture = str(made.json()["id"])
        self.captures.append(capture)
        if engine:
            files, options = self.photos, {"steps": 150}
        else:
            script = {
                "steps": self._random.randint(8, 24),
                "seconds": 0.1,
                "bytes": self._random.choice((1_000, 300_000)),
                "gaussians": self._random.choice((1, 3000)),
            }
            files = {f"images/{SCRIPT}": json.dumps(script).encode(), "images/other.jpg": bytes(50_000)}
            options = {}
        for name, content in files.items():
            if self._ask("PUT", f"/v1/captures/{capture}/{name}", content=content) is None:
                return
        body = {"capture": capture, "options": options}
        headers = {"Idempotency-Key": f"soak-{self.seed}-{self.number}"}
        answer = self._ask("POST", "/v1/jobs", json=body, headers=headers)
        if answer is None:
            return
        cancel = not engine and self.number % 11 == 5
        job = str(answer.json()["id"])
        self.promises[job] = Promise(job, capture, files, cancel)

    def _ask(self, method: str, path: str, **request: Any) -> httpx.Response | None:
        """Send a request until it is answered; None if the soak ends first."""
        while not self._stop.is_set():
            try:
                answer = self._http.request(method, path, **request)
            except httpx.HTTPError:
                answer = None
            if answer is not None and answer.status_code < 400:
                return answer
            if answer is not None and not _may_repeat(answer):
                raise AssertionError(f"{method} {path}: {answer.status_code} {answer.text[:300]}")
            self.retries += 1
            time.sleep(0.2)
        return None

    def _look(self, promise: Promise) -> None:
        try:
            answer = self._http.get(f"/v1/jobs/{promise.job}")
        except httpx.HTTPError:
            return
        if answer.status_code == 404:
            promise.missing_since = promise.missing_since or time.monotonic()
            if time.monotonic() - promise.missing_since > FORGOTTEN_SECONDS:
                promise.state, promise.failure = "failed", "the service does not know the job any more"
            return
        if answer.status_code != 200:
            if not _may_repeat(answer):
                self.complaints.append(f"GET job: {answer.status_code} {answer.text[:300]}")
            return
        promise.missing_since = None
        job = answer.json()
        if job["state"] == "failed":
            self._failed(promise, job["problem"])
        elif job["state"] == "cancelled" and not promise.asked_to_cancel:
            promise.state, promise.failure = "failed", "it was cancelled, and nobody had asked for that"
        else:
            promise.state = job["state"]
        if promise.cancel and not promise.asked_to_cancel and job["state"] == "training":
            self._cancel(promise)
        if promise.state == "succeeded" and self._random.random() < 0.25:
            self._view(promise)

    def _failed(self, promise: Promise, problem: Any) -> None:
        cause = CAUSES.get(problem["code"])
        since = time.monotonic() - _CAUSE_SECONDS
        if cause is None or not any(cause in name and over > since for name, over in self.faults):
            promise.state, promise.failure = "failed", f"{problem['code']}: {problem['detail']}"
            return
        try:
            if self._http.post(f"/v1/jobs/{promise.job}/restart").status_code == 202:
                promise.restarts += 1
                promise.restarted_at = time.monotonic()
        except httpx.HTTPError:
            pass  # the next look sees what became of it

    def _cancel(self, promise: Promise) -> None:
        try:
            answer = self._http.post(f"/v1/jobs/{promise.job}/cancel")
        except httpx.HTTPError:
            promise.asked_to_cancel = True  # it may have arrived
            promise.cancel = False
            return
        promise.asked_to_cancel = promise.asked_to_cancel or answer.status_code in (202, 409)

    def _view(self, promise: Promise) -> None:
        try:
            answer = self._http.post(f"/v1/models/{promise.job}/render", json={"camera": CAMERA})
        except httpx.HTTPError:
            return
        if answer.status_code == 200:
            self.views += answer.content.startswith(b"\x89PNG")
        elif not _may_repeat(answer):
            self.complaints.append(f"a view: {answer.status_code} {answer.text[:300]}")


def _may_repeat(answer: httpx.Response) -> bool:
    """Whether an answer tells the client to come again: a part is away, or the disk is full."""
    return answer.status_code in (429, 502, 503, 504, 507)
