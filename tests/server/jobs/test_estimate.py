"""Estimates of the time of a job: from which finished jobs, how they are scaled, and the answer without any.

Not proved here: how close an estimate comes. The records are those of a real job (tests/fixtures/formats), changed.
"""

import json
import re
from typing import Any

import pytest

from splatmill.backplane import lists
from splatmill.backplane.jobs.row import now
from splatmill.backplane.storage import layout
from splatmill.schema import EstimateJob, TrainOptions
from splatmill.schema.conflicts import CONFLICTS
from splatmill_server.jobs.estimate import estimate, least_within
from splatmill_server.jobs.finished import Figures, figures
from tests.support.plans.facts import changed, planned
from tests.support.served_app import ServedApp, problem
from tests.support.stored.formats import V1, job_ids

STORED = V1 / "storage" / "models" / job_ids()["succeeded"]


def records() -> tuple[dict[str, Any], dict[str, Any]]:
    return json.loads((STORED / "job.json").read_text()), json.loads((STORED / "report.json").read_text())


def job(**changes: Any) -> Figures:
    """A job of 20 photos that took 10 s for the cameras, 60 s to train, 0.1 s per photo and 5 s for all else."""
    fields: dict[str, Any] = {
        "photos": 20,
        "posed": False,
        "preset": "balanced",
        "sized": False,
        "image_size": 640,
        "steps": 3000,
        "kernels": "cpu",
        "machine": "a processor, 2 cores",
        "cameras": 10.0,
        "train": 60.0,
        "by_photo": 2.0,
        "fixed": 5.0,
        "pixel_share": 0.5,
    }
    return Figures(**(fields | changes))


def seconds(request: dict[str, Any], *finished: Figures) -> list[float | None]:
    result = estimate(EstimateJob.model_validate(request), finished)
    return [stage.seconds for stage in result.stages]


def test_stages_are_scaled_by_photos_and_steps() -> None:
    assert seconds({"photos": 20}, job()) == [10.0, 60.0, 7.0]
    assert seconds({"photos": 40}, job()) == [20.0, 60.0, 9.0]
    assert (
        seconds({"photos": 200}, job())[1] == 126.0
    )  # 36 steps for each of the 175 photos that are trained on
    assert seconds({"photos": 20, "options": {"preset": "draft"}}, job())[1] == 20.0
    assert seconds({"photos": 20, "options": {"steps": 6000}}, job())[1] == 120.0
    assert seconds({"photos": 20, "options": {"target_psnr": 30}}, job())[1] == 200.0  # of the preset quality


def test_a_preset_may_take_as_long_as_its_doubled_steps() -> None:
    for options, highest in (({}, 240.0), ({"target_psnr": 30}, 800.0), ({"steps": 3000}, 60.0)):
        training = estimate(EstimateJob.model_validate({"photos": 20, "options": options}), [job()]).stages[1]
        assert (training.lowest, training.highest) == (training.seconds, highest)
        assert (f"up to {round(highest * 50)} while doubling them gains enough" in training.because) == (
            "steps" not in options
        )


def test_a_preset_is_not_doubled_where_the_plan_does_not_double_it() -> None:
    """Of 13 photos two are held out, and of the eleven others the plan sets none aside."""
    for photos, options, doubled in (
        (13, {}, False),
        (14, {}, True),
        (12, {"holdout": 0}, True),
        (30, {"test_views": [f"{each}.jpg" for each in range(19)]}, False),
        (13, {"target_psnr": 30}, True),
    ):
        training = estimate(
            EstimateJob.model_validate({"photos": photos, "options": options}), [job()]
        ).stages[1]
        assert training.seconds is not None
        assert training.highest == training.seconds * (4 if doubled else 1)
        trained = photos - TrainOptions.model_validate(options).held_out_of(photos)
        plan = planned(changed(views=trained), **options)
        assert (plan.schedule.longest is not None) == doubled
        assert ("too few to measure" in training.because) == (not doubled)


def test_a_time_budget_is_the_time_of_the_training() -> None:
    assert seconds({"photos": 20, "options": {"time_budget": "2m"}}) == [None, 120.0, None]
    assert seconds({"photos": 20, "options": {"time_budget": "2m"}}, job()) == [10.0, 120.0, 7.0]
    both = {"photos": 20, "options": {"time_budget": "2m", "steps": 1000}}
    assert seconds(both, job())[1] == 20.0
    assert seconds(both)[1] == 120.0


def test_training_gets_what_is_left_of_the_time_for_the_whole_job() -> None:
    request = {"photos": 20, "options": {"within": "2m"}}
    assert seconds(request, job()) == [10.0, 103.0, 7.0]
    assert estimate(EstimateJob.model_validate(request), [job()]).seconds == 120.0
    unknown = estimate(EstimateJob.model_validate(request), [])
    assert (unknown.stages[1].seconds, unknown.seconds, unknown.highest) == (None, 120.0, 120.0)
    shorter = {"photos": 20, "options": {"within": "2m", "time_budget": 30}}
    assert seconds(shorter, job()) == [10.0, 30.0, 7.0]
    assert seconds({"photos": 20, "options": {"within": "2m", "steps": 1000}}, job())[1] == 20.0
    assert seconds({"photos": 20, "options": {"within": 10}}, job())[1] == 0.0


def test_the_least_time_is_that_of_the_fastest_job_with_a_step_on_each_photo() -> None:
    request = EstimateJob.model_validate({"photos": 40, "options": {"within": 10, "time_budget": 5}})
    assert least_within(request, [job(cameras=12.0), job()], recovered=False) == 20.0 + 40 * 0.02 + 9.0
    assert least_within(request, [job()], recovered=True) == 40 * 0.02 + 9.0
    assert least_within(request, [], recovered=False) is None


def test_a_job_that_cannot_end_in_its_time_is_refused_with_the_least_time(app: ServedApp) -> None:
    capture = app.capture(*(f"{number}.jpg" for number in range(20)))
    body = {"capture": capture, "options": {"within": 5}}
    assert app.http.post("/v1/jobs", json=body).status_code == 202  # nothing is known of this machine yet
    stored, report = records()
    report["sfm"] = {"seconds": {"features": 20.0, "matching": 10.5}}
    report["facts"]["source"] = "sfm"
    app.service.storage.put(layout.job_record(STORED.name), json.dumps(stored).encode())
    app.service.storage.put(layout.model_file(STORED.name, "report.json"), json.dumps(report).encode())
    lists.add_model(app.redis, STORED.name, now(), "default")
    advice = problem(app.http.post("/v1/jobs", json=body), 422, "option_out_of_range")["advice"]
    least = int(re.findall(r"within to (\d+) s", advice)[0])
    assert least > 20 / 8 * 30.5
    # The estimate, which is asked before photos are sent, refuses it likewise.
    asked: dict[str, Any] = {"photos": 20, "options": body["options"]}
    refused = problem(app.http.post("/v1/estimate", json=asked), 422, "option_out_of_range")
    assert refused["advice"] == advice
    assert [error["where"] for error in refused["facts"]["errors"]] == ["options.within"]
    assert f"Give {least} s or more" in refused["facts"]["errors"][0]["what"]
    assert app.http.post("/v1/estimate", json=asked | {"exact": False}).status_code == 200  # a video
    assert app.http.post("/v1/estimate", json=asked | {"options": {"within": least}}).status_code == 200
    for seconds, status in ((least - 1, 422), (least, 202)):
        body["options"] = {"within": seconds}
        assert app.http.post("/v1/jobs", json=body).status_code == status
    # The cameras of this capture are there now.
    app.service.storage.put(f"{layout.capture_sfm(capture)}/model/cameras.bin", b"cameras")
    body["options"] = asked["options"] = {"within": round(least - 20 / 8 * 30.5) + 1}
    assert app.http.post("/v1/estimate", json=asked).status_code == 422
    assert app.http.post("/v1/estimate", json=asked | {"capture": capture}).status_code == 200
    problem(app.http.post("/v1/estimate", json=asked | {"capture": "f" * 16}), 404, "capture_not_found")
    assert app.http.post("/v1/jobs", json=body).status_code == 202


@pytest.mark.parametrize("address", ["/v1/estimate", "/v1/jobs"])
def test_options_that_exclude_each_other_are_refused_with_an_error_for_each(
    app: ServedApp, address: str
) -> None:
    options = {"pose_refinement": "on", "cluster_culling": "on", "backend": "gpu"}
    body = {"options": options} | ({"photos": 20} if "estimate" in address else {"capture": "f" * 16})
    refused = problem(app.http.post(address, json=body), 422, "option_out_of_range")
    assert refused["detail"] == CONFLICTS[0].reason
    assert [(error["where"], error["what"]) for error in refused["facts"]["errors"]] == [
        (f"options.{name}", conflict.reason) for conflict in CONFLICTS[:2] for name in conflict.names
    ]


def test_only_the_share_of_a_step_that_pixels_take_grows_with_them() -> None:
    # Twice the side is four times the pixels: half of the step takes four times as long, the other half as before.
    assert seconds({"photos": 20, "options": {"image_size": 1280}}, job())[1] == 150.0
    assert seconds({"photos": 20, "options": {"image_size": 1280}}, job(pixel_share=0.0))[1] == 60.0


def test_the_jobs_that_are_most_alike_decide_and_give_a_range() -> None:
    small = [job(photos=20, cameras=seconds) for seconds in (8.0, 9.0, 10.0, 11.0, 14.0)]
    large = [job(photos=400, cameras=4000.0)] * 3
    result = estimate(EstimateJob(photos=20), [*large, *small])
    cameras = result.stages[0]
    assert (cameras.lowest, cameras.seconds, cameras.highest) == (8.0, 10.0, 14.0)
    assert result.jobs == 8
    assert result.seconds == sum(stage.seconds or 0.0 for stage in result.stages)
    assert result.lowest is not None
    assert result.highest is not None
    assert result.lowest < result.seconds < result.highest
    assert "0.5 s per photo" in cameras.because
    assert seconds({"photos": 400}, *large, *small)[0] == 4000.0


def test_other_machines_kernels_and_kinds_of_cameras_do_not_count() -> None:
    other = job(machine="another", train=1.0)
    assert seconds({"photos": 20}, job(), other)[1] == 60.0
    assert seconds({"photos": 20}, other, job())[1] == 1.0  # the machine of the newest job
    gpu = job(kernels="gpu", machine="a card", train=3.0)
    assert seconds({"photos": 20, "options": {"backend": "gpu"}}, job(), gpu)[1] == 3.0
    assert seconds({"photos": 20, "options": {"backend": "cpu"}}, gpu, job())[1] == 60.0
    result = estimate(EstimateJob(photos=20, posed=True), [job()])
    assert result.stages[0].seconds is None
    assert result.seconds is None  # no sum without one of its parts
    assert "came with the photos" in result.stages[0].because
    assert seconds({"photos": 20, "posed": True}, job(), job(posed=True, cameras=1.0))[0] == 1.0


def test_nothing_is_made_up_without_history() -> None:
    result = estimate(EstimateJob(photos=20), [])
    assert result.model_dump(include={"seconds", "lowest", "highest", "jobs", "machine"}) == {
        "seconds": None,
        "lowest": None,
        "highest": None,
        "jobs": 0,
        "machine": None,
    }
    assert all(
        stage.seconds is None and "finished on this server yet" in stage.because for stage in result.stages
    )


def test_figures_are_read_from_the_records_of_a_real_job() -> None:
    stored, report = records()
    numbers = figures(stored, report)
    assert numbers is not None
    assert (numbers.photos, numbers.posed, numbers.steps, numbers.image_size, numbers.kernels) == (
        8,
        True,
        60,
        64,
        "cpu",
    )
    assert numbers.machine == "AMD EPYC, 2 cores"
    assert numbers.train == pytest.approx(0.1211, abs=1e-4)
    # All of its 17.40 s are accounted for.
    wall = numbers.cameras + numbers.train + numbers.by_photo + numbers.fixed
    assert wall == pytest.approx(17.4024, abs=1e-3)
    assert 0.0 < numbers.pixel_share < 1.0
    assert figures({**stored, "attempt": 2}, report) is None
    assert figures(stored, {**report, "edit": {"model": "before"}}) is None, (
        "an edit has the report of its training"
    )


def test_cameras_that_an_earlier_job_recovered_count_with_the_time_that_took() -> None:
    stored, report = records()
    report["sfm"] = {"seconds": {"features": 20.0, "matching": 10.5}}
    numbers = figures(stored, {**report, "facts": report["facts"] | {"source": "sfm"}})
    assert numbers is not None
    assert (numbers.cameras, numbers.posed) == (30.5, False)


def test_the_endpoint_estimates_from_stored_models_and_creates_nothing(app: ServedApp) -> None:
    body = {"photos": 8, "posed": True, "options": {"steps": 120}}
    assert app.http.post("/v1/estimate", json=body).json()["jobs"] == 0
    for name in ("report.json", "job.json"):
        app.service.storage.put(layout.model_file(STORED.name, name), (STORED / name).read_bytes())
    broken = "0123456789abcdef"
    app.service.storage.put(layout.model_file(broken, "report.json"), b"{}")
    app.service.storage.put(layout.job_record(broken), b'{"attempt": 1}')
    for model_id in (STORED.name, broken):
        lists.add_model(app.redis, model_id, now(), "default")
    answer = app.http.post("/v1/estimate", json=body).json()
    assert answer["jobs"] == 1  # the one that cannot be read is left out
    assert answer["stages"][1]["seconds"] == pytest.approx(2 * 0.1211, abs=0.1)
    assert answer["seconds"] == pytest.approx(17.5, abs=0.2)
    assert STORED.name not in json.dumps(answer)
    assert app.http.get("/v1/jobs").json()["jobs"] == []


def test_options_are_checked_as_those_of_a_job(app: ServedApp) -> None:
    answer = app.http.post("/v1/estimate", json={"photos": 8, "options": {"image_size": 5}})
    assert problem(answer, 422, "option_out_of_range")["facts"]["errors"][0]["where"] == "options.image_size"
    problem(app.http.post("/v1/estimate", json={"photos": 8, "options": {"size": 5}}), 422, "unknown_option")
    problem(app.http.post("/v1/estimate", json={"photos": 0}), 422, "invalid_request")


def test_info_tells_which_files_are_accepted_and_where_the_server_listens(app: ServedApp) -> None:
    info = app.http.get("/v1/info").json()
    assert ".jpg" in info["accepted"]["photos"]
    assert ".zip" in info["accepted"]["archives"]
    assert info["accepted"]["min_photo_side"] == 16
    assert info["local"] is True
