"""Decoding processes of true jobs are killed at random moments: photos, structure from motion and training, and no job
fails.

Each moment by itself is met in tests/worker/images/test_ended_decoders.py; `make soak` kills all kinds of processes.
"""

import os
import random
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from splatmill_worker import synthetic
from tests.support.up import Up

pytestmark = pytest.mark.slow

JOBS, PHOTOS, KILLS, SEED = 3, 11, 25, 37


@pytest.fixture(scope="module")
def true_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    up = Up(tmp_path_factory.mktemp("true") / "data")
    del up.environment["SPLATMILL_PIPELINE"]
    yield up.start()
    up.close()


def submit(up: Up, folder: Path) -> str:
    """A job on its own capture, so that its cameras are recovered anew."""
    capture = str(up.http.post("/v1/captures", json={}).json()["id"])
    for path in sorted(folder.glob("*.jpg")):
        up.http.put(
            f"/v1/captures/{capture}/images/{path.name}", content=path.read_bytes()
        ).raise_for_status()
    options = {"steps": 30, "max_gaussians": 2000, "holdout": 0}
    answer = up.http.post("/v1/jobs", json={"capture": capture, "options": options}).raise_for_status()
    return str(answer.json()["id"])


def test_no_job_fails_where_its_decoders_are_killed(true_service: Up, tmp_path: Path) -> None:
    up = true_service
    folder = tmp_path / "photos"
    folder.mkdir()
    synthetic.capture(folder, PHOTOS, 320, 240)
    jobs = [submit(up, folder) for _ in range(JOBS)]
    over = threading.Event()
    moments = random.Random(SEED)
    kills = 0

    def kill() -> None:
        nonlocal kills
        while not over.wait(moments.uniform(0.05, 1.5)) and kills < KILLS:
            for child in up.tree():
                with suppress(psutil.Error):
                    if "splatmill_worker.images.decoder" in child.cmdline():
                        os.kill(child.pid, signal.SIGKILL)
                        kills += 1

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        ended = [up.ended(job, 400) for job in jobs]
    finally:
        over.set()
        killer.join()
    assert [(job["state"], job["problem"]) for job in ended] == [("succeeded", None)] * JOBS
    assert kills >= JOBS
