"""The SDK against the real server and a real Redis: the whole life of a job as a program sees it.

Does not prove that the worker keeps its side: here the test itself appends a worker's events and stores its model.
"""

import asyncio
import hashlib
import random
import struct
import threading
from pathlib import Path

import httpx
import pytest
from pydantic import SecretStr

from splatmill import AsyncClient, Client, JobCancelled, JobFailed, WaitTimeout
from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.errors import Conflict, InvalidRequest, NotFound, NothingToUpload, Unauthorized
from splatmill.schema import (
    JobState,
    LogEvent,
    Placement,
    PlanEvent,
    Problem,
    Progress,
    ProgressEvent,
    StateEvent,
    TrainOptions,
    describe_options,
)
from splatmill_server.app import create_app

PROPERTIES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
PROPERTIES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
LINES = [f"property float {name}" for name in PROPERTIES]
HEADER = "\n".join(["ply", "format binary_little_endian 1.0", "element vertex 1", *LINES, "end_header\n"])
PLY = HEADER.encode() + struct.pack(f"<{len(PROPERTIES)}f", *range(len(PROPERTIES)))


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "my photos"
    folder.mkdir()
    generator = random.Random(1)
    for n in range(5):
        (folder / f"IMG {n} é.jpg").write_bytes(generator.randbytes(50_000 + n))
    return folder


def test_the_life_of_a_job(service, photos, tmp_path):
    with Client(service.url) as client:
        sent: list[Progress] = []
        job = client.train(photos, name="tea", steps=10, time_budget="2m", on_progress=sent.append)
        assert job.state is JobState.queued
        assert (job.job.options.steps, job.job.options.time_budget) == (10, 120)
        assert job.job.name == "tea"
        assert sent[-1].done == sent[-1].total
        stored = {file.name: file.sha256 for file in client.capture(job.job.capture).files}
        assert stored == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in photos.iterdir()}
        with pytest.raises(Conflict, match="queued"):
            job.result()

        service.begin(job.id)
        steps = [ProgressEvent(stage="training", done=n, total=3, step=n, loss=1 / n) for n in (1, 2, 3)]
        service.say(job.id, StateEvent(state=JobState.training), PlanEvent(plan={"sh_degree": 2}), *steps)
        with pytest.raises(NotFound):
            job.snapshot()
        assert job.watch() > 5
        service.redis.hset(keys.snapshot(job.id), mapping={"ply": PLY, "tag": "1-3"})
        assert job.snapshot() == PLY
        placed = Placement(final=True, cameras=[], points=[(0, 1, 2)], colors=[(9, 9, 9)], points_total=1)
        service.storage.put(layout.job_cameras(job.id), placed.model_dump_json().encode())
        assert job.cameras() == placed
        threading.Timer(0.2, service.finish, [job.id, PLY]).start()
        heard: list[tuple[Progress, threading.Thread]] = []
        model = job.wait(lambda progress: heard.append((progress, threading.current_thread())))
        assert [progress.step for progress, _ in heard] == [1, 2, 3]
        assert {thread for _, thread in heard} == {threading.current_thread()}
        assert model.model.gaussians == 1
        assert job.refresh().plan == {"sh_degree": 2}
        assert job.report().curve[0].psnr == 25

        for name, start in (("model.ply", b"ply"), ("report.html", b"<p>")):
            assert model.download(tmp_path, file=name).read_bytes().startswith(start)
        assert (tmp_path / "model.ply").read_bytes() == PLY
        assert [camera.split for camera in model.cameras()] == ["test"]
        assert [entry.id for entry in client.models()] == [job.id]
        job.delete()
        with pytest.raises(NotFound):
            client.model(job.id)


def test_a_lost_server_does_not_lose_the_job(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        service.say(job.id, *(LogEvent(message=f"before {n}") for n in range(3)))
        said = []
        for record in job.events():
            if isinstance(record.event, LogEvent):
                said.append(record.event.message)
            if said == ["before 0", "before 1", "before 2"]:
                service.stop()
                service.say(job.id, *(LogEvent(message=f"meanwhile {n}") for n in range(2)))
                service.start()
                service.finish(job.id, PLY)
        assert said == ["before 0", "before 1", "before 2", "meanwhile 0", "meanwhile 1"]
        assert job.state is JobState.succeeded


def test_a_failed_job_says_why(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        problem = Problem.of(
            "sfm_too_few_registered",
            "Registered 2 of 5 images.",
            facts={"registered": 2},
            advice="Overlap more.",
        )
        service.fail(job.id, problem)
        with pytest.raises(JobFailed, match=r"Registered 2 of 5 images\. Overlap more\.") as failed:
            job.wait()
        assert failed.value.code == "sfm_too_few_registered"
        assert failed.value.problem.facts == {"registered": 2}
        with pytest.raises(NotFound):
            client.model(job.id)
        assert job.restart().state is JobState.queued


def test_cancelling(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        job.cancel()
        with pytest.raises(JobCancelled, match=job.id):
            job.wait()
        assert job.cancel().state is JobState.cancelled, "wishing twice is wishing once"


def test_waiting_has_a_limit_and_the_job_continues(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        with pytest.raises(WaitTimeout, match=f"The job {job.id} has not ended within 0.3 seconds") as late:
            job.wait(timeout=0.3)
        assert isinstance(late.value, TimeoutError)
        assert (late.value.job_id, late.value.state, late.value.seconds) == (job.id, "preparing", 0.3)
        assert job.refresh().state is JobState.preparing
        service.finish(job.id, PLY)
        assert job.wait(timeout=30).id == job.id

    async def impatient() -> None:
        async with AsyncClient(service.url) as client:
            await (await client.submit(job.job.capture)).wait(timeout=0.1)

    with pytest.raises(WaitTimeout, match="queued"):
        asyncio.run(impatient())


def test_a_timeout_of_the_callers_own_is_not_taken_for_the_limit(service, photos):
    def fail(_: Progress) -> None:
        raise TimeoutError("mine")

    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        service.say(job.id, ProgressEvent(stage="training", done=1, total=3))
        with pytest.raises(TimeoutError, match="mine"):
            job.wait(fail, timeout=30)


def test_a_job_that_is_deleted_while_it_is_followed(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        events = job.events()
        next(events)
        service.fail(job.id, Problem.of("diverged", "It diverged."))
        client.job(job.id).delete()
        with pytest.raises(NotFound) as gone:
            for _ in events:
                pass
        assert gone.value.code == "job_not_found"


def test_a_client_closes_while_events_are_read(service, photos, caplog):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        events = job.events()
        assert next(events).event.type == "state"
    assert caplog.messages == []
    del events  # what an abandoned iteration leaves open would be reported when it is collected


def test_lists_can_be_narrowed(service, photos):
    with Client(service.url) as client:
        kitchen, _ = client.upload(photos, name="Kitchen, 2nd floor")
        garden, _ = client.upload(photos, name="garden")
        made = [client.submit(kitchen.id, name=f"kitchen {n}").id for n in range(4)]
        other = client.submit(garden.id, name="GARDEN")
        unnamed = client.submit(garden.id).id
        client.job(made[0]).cancel()
        service.begin(other.id)
        service.finish(other.id, PLY)

        def jobs(**filters) -> list[str]:
            return [job.id for job in client.jobs(**filters)]

        assert jobs(name="KITCHEN") == made[::-1]
        assert jobs(name="garden") == [other.id]
        assert jobs(capture=garden.id) == [unnamed, other.id]
        assert jobs(state="cancelled") == [made[0]]
        assert jobs(state=[JobState.cancelled, "succeeded"]) == [other.id, made[0]]
        assert jobs(state="queued", name="kitchen", limit=2) == made[:1:-1]
        assert jobs(name="no such") == []
        with pytest.raises(InvalidRequest, match="state"):
            jobs(state="sleeping")
        assert [capture.id for capture in client.captures()] == [garden.id, kitchen.id]
        assert [capture.id for capture in client.captures(limit=1)] == [garden.id]
        assert [capture.id for capture in client.captures(name="2ND")] == [kitchen.id]
        assert [model.id for model in client.models(name="gard")] == [other.id]
        assert list(client.models(name="kitchen")) == []


def test_deleting_captures_and_models(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        with pytest.raises(Conflict) as used:
            client.delete_capture(job.job.capture)
        assert used.value.problem.facts == {"job": job.id}
        service.begin(job.id)
        service.finish(job.id, PLY)
        job.wait().delete()
        with pytest.raises(NotFound):
            job.refresh()
        client.delete_capture(job.job.capture)
        with pytest.raises(NotFound):
            client.capture(job.job.capture)


def test_what_is_in_the_bin_can_be_restored(service, photos):
    with Client(service.url) as client:
        job = client.train(photos)
        service.begin(job.id)
        service.finish(job.id, PLY)
        model = job.wait()
        assert model.rename("Vase").name == job.refresh().name == job.rename("Vase").name == "Vase"
        binned = client.bin.put_job(job.id)
        assert (binned.name, binned.model) == ("Vase", model.id)
        client.bin.put_capture(job.job.capture)
        assert [*client.jobs(), *client.models(), *client.captures()] == []
        assert {entry.id for entry in client.bin.list()} == {job.id, job.job.capture}
        client.bin.restore_job(job.id)
        client.bin.restore_capture(job.job.capture)
        assert [entry.id for entry in client.models()] == [model.id]
        with pytest.raises(NotFound):
            client.bin.restore_job(job.id)
        assert model.rename(None).name is None
        assert model.label(tags=["garden", "Garden"]).tags == job.label(favourite=True).tags == ["garden"]
        assert [entry.id for entry in client.models(tag="GARDEN", favourite=True, sort="name")] == [model.id]
        assert [entry.id for entry in client.jobs(tag="garden", favourite=False)] == []
        with pytest.raises(InvalidRequest):
            model.label(tags=["a,b"])


def test_all_jobs_page_by_page(service, photos):
    with Client(service.url) as client:
        capture, _ = client.upload(photos)
        made = [client.submit(capture.id, name=str(n)).id for n in range(5)]
        assert [job.id for job in client.jobs()] == made[::-1]
        assert [job.id for job in client.jobs(limit=2)] == made[:2:-1]
        assert list(client.jobs(limit=0)) == []


def test_uploading_again_into_a_capture_stores_nothing_twice(service, photos):
    with Client(service.url) as client:
        capture, first = client.upload(photos)
        again, second = client.upload(photos, capture=capture.id)
        assert again.id == capture.id
        assert {f.sha256 for f in first.files} == {f.sha256 for f in second.files}
        assert len(client.capture(capture.id).files) == 5
        (photos / "IMG 0 é.jpg").write_bytes(b"other bytes")
        with pytest.raises(Conflict) as error:
            client.upload(photos, capture=capture.id)
        assert error.value.code == "name_taken"


def test_what_cannot_be_trained_is_refused(service, tmp_path):
    (tmp_path / "only.jpg").write_bytes(b"x" * 100)
    with Client(service.url) as client:
        with pytest.raises(InvalidRequest) as error:
            client.train(tmp_path)
        assert error.value.code == "too_few_images"
        with pytest.raises(NotFound):
            client.submit("0123456789abcdef")


def test_what_the_server_says_of_itself(service):
    with Client(service.url) as client:
        assert client.options() == describe_options()
        assert client.info().limits.max_render_pixels > 0
        ready = client.ready()
        assert set(ready.checks) >= {"storage"}


def test_an_estimate_is_a_question(service):
    with Client(service.url) as client:
        estimate = client.estimate(24, TrainOptions(time_budget=90), posed=True)
        assert [stage.seconds for stage in estimate.stages] == [None, 90.0, None]
        assert estimate.seconds is None
        assert list(client.jobs()) == []


def test_a_key_is_asked_for_and_given(settings, monkeypatch):
    app = create_app(settings.model_copy(update={"api_key": SecretStr("s3cret")}))

    async def info(key: str | None) -> str:
        transport = httpx.ASGITransport(app)
        async with AsyncClient("http://splatmill", api_key=key, transport=transport) as client:
            return (await client.info()).version

    with pytest.raises(Unauthorized):
        asyncio.run(info(None))
    with pytest.raises(Unauthorized):
        asyncio.run(info("wrong"))
    assert asyncio.run(info("s3cret"))


def test_several_jobs_on_one_loop(service, photos):
    async def follow(client: AsyncClient) -> JobState:
        job = await client.train(photos)
        service.begin(job.id)
        service.finish(job.id, PLY)
        model = await job.wait()
        return (await client.job(model.id)).state

    async def main() -> list[JobState]:
        async with AsyncClient(service.url) as client:
            return await asyncio.gather(*(follow(client) for _ in range(3)))

    assert asyncio.run(main()) == [JobState.succeeded] * 3


def test_a_model_to_start_from_is_sent_beside_the_poses(service, photos, tmp_path):
    (tmp_path / "before.ply").write_bytes(PLY)
    with Client(service.url) as client:
        job = client.train(photos, start=tmp_path / "before.ply", steps=10)
        assert job.job.options.start == "before.ply"
        sent = [file for file in client.capture(job.job.capture).files if file.role == "poses"]
        assert [(file.name, file.sha256) for file in sent] == [
            ("before.ply", hashlib.sha256(PLY).hexdigest())
        ]
        with pytest.raises(NothingToUpload, match="does not exist"):
            client.train(photos, start=tmp_path / "gone.ply")
        (photos / "inside.ply").write_bytes(PLY)
        inside = client.train(photos, start="inside.ply", steps=10).job
        assert inside.options.start == "inside.ply"
        assert "inside.ply" in {file.name for file in client.capture(inside.capture).files}
        service.begin(job.id)
        service.finish(job.id, PLY)
        assert client.train(photos, start=job.id).job.options.start_model == job.id
