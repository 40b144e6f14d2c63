"""A job's life through the embedded service: from upload to model, and every way a job fails by itself.

The pipeline is a stand-in: nothing here says that a model looks like its photos.
"""

import hashlib
import json
import time
from datetime import datetime

import pytest

from tests.support.up import Up
from tests.support.waiting import gone, wait_for

pytestmark = pytest.mark.slow


def test_a_job_becomes_a_model_and_leaves_no_work_behind(service: Up) -> None:
    job_id = service.submit(steps=5)
    job = service.ended(job_id)
    assert job["state"] == "succeeded", job
    assert job["attempt"] == 1
    assert job["plan"]["steps"]["value"] == 5
    assert job["progress"]["step"] == 5

    model = service.http.get(f"/v1/models/{job_id}").json()
    assert model["gaussians"] == 400
    assert model["psnr"] == 30.0
    assert {file["name"] for file in model["files"]} >= {
        "model.ply",
        "report.json",
        "cameras.json",
        "job.json",
    }
    for file in model["files"]:
        body = service.http.get(f"/v1/models/{job_id}/files/{file['name']}").content
        known = None if file["name"] in ("job.json", "preview.jpg") else hashlib.sha256(body).hexdigest()
        assert file["sha256"] == known, file
    record = json.loads((service.data / "storage/models" / job_id / "job.json").read_text())
    assert record["state"] == "succeeded"
    assert service.http.get(f"/v1/jobs/{job_id}/preview").content.startswith(b"\xff\xd8")
    assert not (service.data / "work" / job_id).exists()


def test_events_tell_every_state_in_order(service: Up) -> None:
    job_id = service.submit(steps=5)
    states, steps = [], []
    with service.http.stream("GET", f"/v1/jobs/{job_id}/events") as stream:
        for line in stream.iter_lines():
            if not line.startswith("data:"):
                continue
            event = json.loads(line.removeprefix("data:"))["event"]
            if event["type"] == "state":
                states.append(event["state"])
            if event["type"] == "progress" and event.get("step"):
                steps.append(event["step"])
    told = [state for state in states if state != "queued"]
    assert told == ["preparing", "sfm", "training", "exporting", "succeeded"]
    assert steps == sorted(steps)
    assert steps[-1] == 5


def test_an_unknown_error_fails_once_with_its_trace_in_the_log(service: Up) -> None:
    job_id = service.submit(do="raise", at=3)
    job = service.ended(job_id)
    assert job["state"] == "failed"
    assert job["problem"]["code"] == "internal_error"
    assert "the stand-in was told to fail" in job["problem"]["detail"]
    assert len(service.diary(job_id)) == 1
    lines = service.http.get(f"/v1/jobs/{job_id}/logs").json()["lines"]
    assert any("Traceback" in line["message"] for line in lines)


def test_want_of_memory_is_named_and_advised_on(service: Up) -> None:
    job_id = service.submit(do="memory", at=2)
    problem = service.ended(job_id)["problem"]
    assert problem["code"] == "out_of_memory"
    assert "image_size" in problem["advice"]


def test_a_process_that_keeps_dying_is_given_up_by_name(service: Up) -> None:
    job_id = service.submit(do="segv", at=3)
    job = service.ended(job_id)
    assert job["state"] == "failed"
    assert job["problem"]["code"] == "attempts_exhausted"
    assert job["problem"]["facts"]["signal"] == "SIGSEGV"
    assert job["problem"]["facts"]["attempts"] == 4
    attempts = service.diary(job_id)
    assert [attempt["from"] for attempt in attempts] == [0, 2, 2, 2]
    assert not any(attempt["overlap"] for attempt in attempts)


def test_a_restarted_job_goes_on_after_a_cancel(service: Up) -> None:
    job_id = service.submit(steps=40)
    service.reached(job_id, 10)
    service.http.post(f"/v1/jobs/{job_id}/cancel")
    job = service.ended(job_id)
    assert job["state"] == "cancelled", job
    assert service.http.post(f"/v1/jobs/{job_id}/restart").status_code in (200, 202)
    job = service.ended(job_id)
    assert job["state"] == "succeeded"
    assert service.diary(job_id)[-1]["from"] >= 10


def test_a_deleted_job_is_gone_everywhere(service: Up) -> None:
    job_id = service.submit(steps=3)
    service.ended(job_id)
    assert service.http.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert service.http.get(f"/v1/jobs/{job_id}").status_code == 404
    assert service.http.get(f"/v1/models/{job_id}").status_code == 404
    assert not list((service.data / "storage").rglob(f"*{job_id}*"))
    with service.redis() as connection:
        left = {key: connection.ttl(key) for key in connection.scan_iter(match=f"splatmill:*{job_id}*")}
    # The mark of the deletion keeps jobs that are being created from starting from the model; it expires.
    assert left.keys() == {f"splatmill:deleting:model/{job_id}".encode()}
    assert all(0 < seconds <= 600 for seconds in left.values())


def test_a_full_disk_fails_the_job_by_name_and_the_next_one_works(own_service: Up) -> None:
    own_service.start(largest_file=1_000_000)
    job_id = own_service.submit(steps=2, gaussians=40_000)
    problem = own_service.ended(job_id)["problem"]
    assert problem["code"] == "storage_full"
    assert "space" in problem["advice"]
    assert own_service.http.get(f"/v1/models/{job_id}").status_code == 404
    assert own_service.ended(own_service.submit(steps=2))["state"] == "succeeded"


def test_cancel_during_training_is_reported_within_two_seconds_with_no_process_left(service: Up) -> None:
    job_id = service.submit(steps=1000)
    service.reached(job_id, 5)
    trainer = service.trainer(job_id)
    began = time.monotonic()
    service.http.post(f"/v1/jobs/{job_id}/cancel")
    job = service.ended(job_id)
    seconds = time.monotonic() - began
    assert job["state"] == "cancelled"
    assert gone([trainer])
    assert seconds < 2.0  # the promise of the issue, not a performance figure; measured: hundredths


def test_cancel_lands_inside_native_code(service: Up) -> None:
    job_id = service.submit(steps=1000, do="native", at=3)
    service.reached(job_id, 2)
    trainer = service.trainer(job_id)
    began = time.monotonic()
    service.http.post(f"/v1/jobs/{job_id}/cancel")
    assert service.ended(job_id)["state"] == "cancelled"
    assert gone([trainer])
    assert time.monotonic() - began < 2.0


def test_cancel_of_a_waiting_job_never_starts_it(service: Up) -> None:
    first = service.submit(steps=1000)
    service.reached(first, 2)
    second = service.submit(steps=1000)
    service.http.post(f"/v1/jobs/{second}/cancel")
    assert service.ended(second)["state"] == "cancelled"
    service.http.post(f"/v1/jobs/{first}/cancel")
    service.ended(first)
    # A third job runs: had the second been left in the queue, it would have come first.
    assert service.ended(service.submit(steps=1))["state"] == "succeeded"
    assert service.diary(second) == []


def test_many_small_jobs_end_in_order_each_run_once(service: Up) -> None:
    jobs = [service.submit(steps=1, pause=0.0) for _ in range(5)]
    ended = [service.ended(job_id) for job_id in jobs]
    assert {job["state"] for job in ended} == {"succeeded"}
    finished = [datetime.fromisoformat(job["finished_at"]) for job in ended]
    assert finished == sorted(finished)
    assert wait_for(lambda: all(len(service.diary(job_id)) == 1 for job_id in jobs))
