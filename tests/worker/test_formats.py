"""Files of the first version are read by the worker of today: an interrupted job keeps its plan and its checkpoint.

Not proved here: that the training continues well from there (tests/worker/splat/train resumes its own checkpoints).
"""

import json

from splatmill.schema import Job, ModelCameras, Report
from splatmill_worker.splat.formats import ply
from splatmill_worker.splat.plan.plan_file import read_plan
from splatmill_worker.splat.train import checkpoint
from tests.support.stored.formats import V1, job_ids

MODEL = V1 / "storage" / "models" / job_ids()["succeeded"]


def test_the_plan_and_the_checkpoint_of_an_interrupted_job_are_kept() -> None:
    row = json.loads((V1 / "redis.json").read_text())[f"splatmill:job:{job_ids()['interrupted']}"]["hash"]
    options = Job.model_validate(row | {"options": json.loads(row["options"]), "state": "queued"}).options
    plan = read_plan(V1 / "work" / "plan.json", options)
    assert plan is not None
    assert (plan.max_gaussians, plan.seed, plan.kernels) == (400, 1, "cpu")
    snapshot = checkpoint.load(V1 / "work" / "checkpoints")
    assert snapshot is not None
    assert snapshot.state.step > 20
    assert snapshot.state.budget.steps == 900_000
    assert {len(tensor) for tensor in snapshot.parameters.values()} == {400}
    assert "still_0002.jpg" in snapshot.view_names


def test_the_files_of_a_model_are_readable() -> None:
    report = Report.model_validate_json((MODEL / "report.json").read_text())
    assert (report.curve[-1].step, report.curve[-1].gaussians) == (60, 400)
    assert len(ModelCameras.model_validate_json((MODEL / "cameras.json").read_text()).cameras) == 8
    assert len(ply.read(MODEL / "model.ply").gaussians.means) == 400
    assert Job.model_validate_json((MODEL / "job.json").read_text()).options.steps == 60
