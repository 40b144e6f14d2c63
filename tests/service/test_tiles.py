"""A job in tiles on several workers: the same model whoever trains its tiles, whatever is killed, and nothing after a
cancellation. The engine is the real one, on a tiny scene.

Does not prove that tiles are as good as one piece (tests/worker/tiles), nor a bucket (tests/worker/service/units).
"""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from splatmill.backplane.queue import queue
from splatmill.backplane.storage import layout
from tests.support import still_life
from tests.support.up import Up
from tests.support.waiting import gone, wait_for

pytestmark = pytest.mark.slow

OPTIONS = {
    "tiles": 3,
    "steps": 120,
    "seed": 1,
    "max_gaussians": 3000,
    "holdout": 5,
    "backend": "cpu",
    "lpips": "off",
}


class OtherWorker:
    """A worker with a data folder of its own, beside that of a service."""

    def __init__(self, up: Up, folder: Path) -> None:
        self.log = folder / "worker.log"
        folder.mkdir(exist_ok=True)
        environment = up.environment | {
            "REDIS_URL": f"unix://{up.data / 'redis.sock'}",
            "SPLATMILL_STORAGE": (up.data / "storage").as_uri(),
            "SPLATMILL_DATA": str(folder / "data"),
        }
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "splatmill_worker", "train", "--stop-grace", "5"],
                env=environment,
                stdout=log,
                stderr=log,
            )

    def tiles(self, job_id: str) -> int:
        """How many tiles of a job it has taken."""
        return self.log.read_text().count(f"took {job_id}-1_")

    def trains(self) -> list[int]:
        """The processes below it."""
        return [child.pid for child in psutil.Process(self.process.pid).children(recursive=True)]


@pytest.fixture
def other(service: Up, tmp_path: Path) -> Iterator[Callable[[], OtherWorker]]:
    """Starts workers beside that of the service."""
    started: list[OtherWorker] = []

    def start() -> OtherWorker:
        started.append(OtherWorker(service, tmp_path / f"worker-{len(started)}"))
        return started[-1]

    yield start
    for worker in started:
        worker.process.kill()
        worker.process.wait()


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return still_life.posed_capture(tmp_path_factory.mktemp("still") / "capture")


def submitted(up: Up, photos: Path, **options: Any) -> str:
    capture = up.http.post("/v1/captures", json={}).json()["id"]
    for path in sorted(path for path in photos.rglob("*") if path.is_file()):
        answer = up.http.put(
            f"/v1/captures/{capture}/{path.relative_to(photos).as_posix()}", content=path.read_bytes()
        )
        assert answer.status_code == 201, answer.text
    answer = up.http.post("/v1/jobs", json={"capture": capture, "options": OPTIONS | options})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def model_of(up: Up, job_id: str) -> str:
    """The digest of the model that the job must have made."""
    job = up.ended(job_id)
    assert job["state"] == "succeeded", job
    model = up.data.joinpath("storage", layout.model_file(job_id, "model.ply"))
    return hashlib.sha256(model.read_bytes()).hexdigest()


def lines_of(up: Up, job_id: str) -> list[str]:
    return [line["message"] for line in up.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]]


@pytest.fixture(scope="session")
def undisturbed(shared_service: Up, photos: Path) -> str:
    """The digest of the model that one worker makes by itself."""
    if shared_service.process is None:
        shared_service.start()
    job_id = submitted(shared_service, photos)
    model = model_of(shared_service, job_id)
    lines = lines_of(shared_service, job_id)
    assert [sum(line.startswith(f"tile-{tile} is trained") for line in lines) for tile in (1, 2, 3)] == [
        1,
        1,
        1,
    ]
    assert not list(shared_service.data.joinpath("storage", "jobs", job_id).glob("work/*"))
    return model


def test_workers_that_are_free_train_tiles_and_the_model_is_the_same(
    service: Up, other: Callable[[], OtherWorker], photos: Path, undisturbed: str
) -> None:
    workers = [other(), other()]
    job_id = submitted(service, photos)
    assert model_of(service, job_id) == undisturbed
    assert sum(worker.tiles(job_id) for worker in workers) >= 1
    wait_for(lambda: not list(service.data.joinpath("storage", "jobs", job_id).glob("work/*")))


@pytest.mark.parametrize("whole", [True, False], ids=["worker", "process"])
def test_a_worker_that_is_killed_with_a_tile_costs_nothing_but_time(
    service: Up, other: Callable[[], OtherWorker], photos: Path, undisturbed: str, whole: bool
) -> None:
    worker = other()
    job_id = submitted(service, photos)
    wait_for(lambda: worker.tiles(job_id) and worker.trains(), 120)
    for pid in [worker.process.pid] if whole else worker.trains()[:1]:
        os.kill(pid, signal.SIGKILL)
    assert model_of(service, job_id) == undisturbed


def test_a_worker_that_is_stopped_gives_its_tile_back(
    service: Up, other: Callable[[], OtherWorker], photos: Path, undisturbed: str
) -> None:
    worker = other()
    job_id = submitted(service, photos)
    wait_for(lambda: worker.tiles(job_id) and worker.trains(), 120)
    worker.process.send_signal(signal.SIGTERM)
    assert worker.process.wait(30) == 0
    assert model_of(service, job_id) == undisturbed


def test_units_that_were_done_are_not_repeated_by_the_next_attempt(
    service: Up, photos: Path, undisturbed: str
) -> None:
    job_id = submitted(service, photos)
    wait_for(lambda: any(line.startswith("tile-1 is trained") for line in lines_of(service, job_id)), 120)
    os.kill(service.worker, signal.SIGKILL)
    assert model_of(service, job_id) == undisturbed
    assert service.job(job_id)["attempt"] == 2
    lines = lines_of(service, job_id)
    assert sum(line.startswith("tile-1 is trained") for line in lines) == 1


def test_a_cancellation_ends_the_tiles_of_all_workers(
    service: Up, other: Callable[[], OtherWorker], photos: Path
) -> None:
    worker = other()
    job_id = submitted(service, photos, steps=4000)
    wait_for(lambda: worker.tiles(job_id) and worker.trains(), 120)
    below = worker.trains()
    service.http.post(f"/v1/jobs/{job_id}/cancel")
    assert service.ended(job_id)["state"] == "cancelled"
    wait_for(lambda: gone(below))
    # Not because the tile was trained meanwhile.
    wait_for(lambda: "has ended: stopped" in worker.log.read_text())
    with service.redis() as connection:
        wait_for(lambda: queue.take_back_tile(connection, job_id, 1, 3))


def test_options_of_a_training_in_one_piece_are_refused(service: Up, photos: Path) -> None:
    capture = service.http.post("/v1/captures", json={}).json()["id"]
    answer = service.http.post(
        "/v1/jobs", json={"capture": capture, "options": OPTIONS | {"time_budget": 60}}
    )
    assert answer.status_code == 422
    assert "The option time_budget is for a training in one piece" in answer.text
