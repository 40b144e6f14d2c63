"""The clients of `bench load` in a process of their own, because locust replaces the sockets of the standard library.

    python -m _load.clients '{"url": ..., "clients": 200, "seconds": 20, "job": ..., "model": ..., "camera": {...}}'

Of a hundred clients, 80 ask for a job once a second, 10 follow its events, and 10 upload a photo every two seconds.
Five more look at a model, once a second each, however many the others are. Clients know nothing of each other: each
begins at a random moment, and waits for half to one and a half of its time. With equal waits, those that one stall had
brought together would come together for ever, once a second. The last line of the output is JSON: an object for each
kind of request, and the errors.
"""

import json
import random
import sys
import time
from typing import Any, cast

import gevent.monkey

gevent.monkey.patch_all()

from locust import FastHttpUser, between, constant, events, task  # noqa: E402  # after the sockets are replaced
from locust.env import Environment  # noqa: E402
from locust.stats import StatsEntry  # noqa: E402

VIEWERS = 5
"""Clients that look at a model, each once a second."""

PHOTO_BYTES = 200_000
PHOTOS_PER_CAPTURE = 20

_SPAWN_SECONDS = 5.0  # over which the clients arrive; the figures begin after it
_asked: dict[str, Any] = {}
_moments = random.Random(0)


class Client(FastHttpUser):
    """Begins at a random moment."""

    abstract = True

    def on_start(self) -> None:
        gevent.sleep(_moments.uniform(0, 2))


class Poller(Client):
    """Asks for the state of the job that trains."""

    weight = 80
    wait_time = between(0.5, 1.5)

    @task
    def poll(self) -> None:
        self.client.get(f"/v1/jobs/{_asked['job']}", name="job")


class Follower(Client):
    """Follows the events of that job for as long as the stream lasts; what counts is the time to its first event."""

    weight = 10
    wait_time = constant(1)
    network_timeout = 600.0

    @task
    def follow(self) -> None:
        begun = time.perf_counter()
        error: Exception | None = None
        try:
            with self.client.get(
                f"/v1/jobs/{_asked['job']}/events", name="stream", stream=True, catch_response=True
            ) as answer:
                answer.request_meta["name"] = "stream (its end)"
                answer.success()
                if answer.status_code != 200:
                    raise ConnectionError(f"status {answer.status_code}")
                lines = iter(answer.readline, b"")
                if not any(line.startswith(b"data:") for line in lines):
                    raise ConnectionError("the stream ended without an event")
                _tell("events", begun, None)
                for _ in lines:
                    pass  # the job's events, until it ends
        except Exception as failure:
            error = failure
        if error is not None:
            _tell("events", begun, error)


class Uploader(Client):
    """Uploads photos to captures of its own."""

    weight = 10
    wait_time = between(1, 3)

    def on_start(self) -> None:
        super().on_start()
        self.count = 0
        self.capture = ""

    @task
    def upload(self) -> None:
        if self.count % PHOTOS_PER_CAPTURE == 0:
            self.capture = self.client.post("/v1/captures", json={}, name="capture").json()["id"]
        self.count += 1
        path = f"/v1/captures/{self.capture}/images/{self.count}.jpg"
        self.client.put(path, data=cast(Any, bytes(PHOTO_BYTES)), name="photo")


class Viewer(Client):
    """Fetches the files and pictures of a model."""

    fixed_count = VIEWERS
    wait_time = between(0.5, 1.5)

    @task
    def view(self) -> None:
        self.client.post(
            f"/v1/models/{_asked['model']}/render", json={"camera": _asked["camera"]}, name="view"
        )


def _tell(name: str, begun: float, error: Exception | None) -> None:
    cast(Any, events.request).fire(
        request_type="GET",
        name=name,
        response_time=(time.perf_counter() - begun) * 1000,
        response_length=0,
        exception=error,
        context={},
    )


def main() -> None:
    """Run the clients and print what they met."""
    _asked.update(json.loads(sys.argv[1]))
    users: list[Any] = [Poller, Follower, Uploader, Viewer]
    environment = Environment(user_classes=users, events=events, host=_asked["url"])
    runner = environment.create_local_runner()
    count = int(_asked["clients"])
    runner.start(count + VIEWERS, spawn_rate=max(1.0, (count + VIEWERS) / _SPAWN_SECONDS))
    gevent.sleep(_SPAWN_SECONDS + 3)
    kept = {name: entry for name, entry in _entries(environment).items() if name == "events"}
    connected = {name: _row(name, entry) for name, entry in kept.items()}
    environment.stats.reset_all()
    gevent.sleep(_asked["seconds"])
    rows = {name: _row(name, entry) for name, entry in _entries(environment).items()}
    errors = [
        {"name": error.name, "times": error.occurrences, "said": str(error.error)[:200]}
        for error in environment.stats.errors.values()
    ]
    # Streams open while the clients arrive.
    rows = {name: row for name, row in {**connected, **rows}.items() if not name.startswith("stream")}
    print(json.dumps({"requests": list(rows.values()), "errors": errors}), flush=True)
    runner.stop()


def _entries(environment: Environment) -> dict[str, StatsEntry]:
    return {name: entry for (name, _), entry in environment.stats.entries.items()}


def _row(name: str, entry: StatsEntry) -> dict[str, Any]:
    return {
        "what": name,
        "requests": entry.num_requests,
        "errors": entry.num_failures,
        "p50_ms": entry.get_response_time_percentile(0.5),
        "p99_ms": entry.get_response_time_percentile(0.99),
        "worst_ms": round(entry.max_response_time or 0),
    }


if __name__ == "__main__":
    main()
