"""The clients of a soak: they upload, start jobs, follow, cancel, look at models, and note what was broken to them."""

import random
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import httpx

from _soak import work
from _soak.service import Service

FINAL = {"succeeded", "failed", "cancelled"}

UNFINISHED = 2
"""Jobs that are unfinished at each moment: a fault always meets one, and one waits no longer than for another."""

_CANCELLED = 9
"""One job in so many is cancelled by a client."""

_FORMATS = ("spz", "sog", "glb")
"""File formats in which models are downloaded, in turn; the renderer converts them."""

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
    kind, photos: as `work.Work` says.
    state: the last that was seen.
    cancel: whether a client cancels it.
    restarts: how often a client restarted it after a failure whose advice that is.
    restarted_at: monotonic time of the last restart: before it, the job had ended.
    missing_since: monotonic time since when the service says that there is no such job.
    """

    job: str
    capture: str
    files: dict[str, bytes]
    kind: str = "photos"
    photos: int = work.PHOTOS
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

    files: those of a capture of each kind.
    complaints: what no client should have met.
    captures: those that the service has accepted.
    faults: names of the faults so far, and the monotonic time at which each was over; infinity: it is not over.
    """

    service: Service
    seed: int
    files: dict[str, dict[str, bytes]] = field(default_factory=dict)
    promises: dict[str, Promise] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)
    captures: list[str] = field(default_factory=list)
    faults: list[tuple[str, float]] = field(default_factory=list)
    views: int = 0
    conversions: int = 0
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
        made = self._ask("POST", "/v1/captures", json={})
        if made is None:
            return
        capture = str(made.json()["id"])
        self.captures.append(capture)
        one = work.nth(self.number, self.files)
        for name, content in one.files.items():
            if self._ask("PUT", f"/v1/captures/{capture}/{name}", content=content) is None:
                return
        body = {"capture": capture, "options": one.options}
        headers = {"Idempotency-Key": f"soak-{self.seed}-{self.number}"}
        answer = self._ask("POST", "/v1/jobs", json=body, headers=headers)
        if answer is None:
            return
        job = str(answer.json()["id"])
        cancel = self.number % _CANCELLED == 5
        self.promises[job] = Promise(job, capture, one.files, one.kind, one.photos, cancel)

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
        if promise.state == "succeeded":
            (self._view if self._random.random() < 0.5 else self._convert)(promise)

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

    def _convert(self, promise: Promise) -> None:
        form = _FORMATS[self.conversions % len(_FORMATS)]
        try:
            answer = self._http.get(f"/v1/models/{promise.job}/download/{form}")
        except httpx.HTTPError:
            return
        if answer.status_code == 200:
            self.conversions += 1
        elif not _may_repeat(answer):
            self.complaints.append(f"a download as {form}: {answer.status_code} {answer.text[:300]}")


def _may_repeat(answer: httpx.Response) -> bool:
    """Whether an answer asks the client to come again: a part is away, or the disk is full."""
    return answer.status_code in (429, 502, 503, 504, 507)
