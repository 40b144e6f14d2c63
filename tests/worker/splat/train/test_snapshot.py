"""Proves that a snapshot is all that a roll-back, a resumed run and a checkpoint need, and that checkpoints written
before snapshots existed are still read.

Does not prove when snapshots and checkpoints are taken: test_train.py does.
"""

from __future__ import annotations

import resource
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from splatmill_worker.errors import FailureName, TrainingFailed
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.train import checkpoint
from splatmill_worker.splat.train.poses import Poses
from splatmill_worker.splat.train.run import TrainingRun
from splatmill_worker.splat.train.snapshot import Snapshot
from tests.support.training import first_engine, plan, split

FILE_KEYS = {
    "format", "parameters", "exp_avg", "exp_avg_sq", "step", "seconds", "rows", "recoveries", "rate_scale", "order",
    "random", "views", "poses", "budget", "shortened", "most", "ever_saw", "limited", "best",
}  # fmt: skip


def a_run(course: Plan) -> TrainingRun:
    """A run with everything that a snapshot can hold: refined cameras too."""
    views, _ = split()
    engine = first_engine()
    engine.keep_pose_gradient = True
    return TrainingRun(engine, course, views, 1.1, poses=Poses(views, 1.0))


def course() -> Plan:
    return plan(200, background="random", pose_refinement=True)


def advanced(run: TrainingRun, steps: int) -> TrainingRun:
    for _ in range(steps):
        run.advance()
    return run


def flat(value: Any) -> list[torch.Tensor]:
    """All tensors in nested dictionaries, tuples and lists, in their order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        return [tensor for item in value.values() for tensor in flat(item)]
    if isinstance(value, tuple | list):
        return [tensor for item in value for tensor in flat(item)]
    return []


def same(first: Snapshot, second: Snapshot, *, but: set[str]) -> None:
    """Assert that all fields but these agree, tensors bit by bit."""
    for field in fields(Snapshot):
        if field.name in but:
            continue
        one, other = getattr(first, field.name), getattr(second, field.name)
        tensors = flat(one)
        if tensors:
            assert len(tensors) == len(flat(other)), field.name
            assert all(torch.equal(a, b) for a, b in zip(tensors, flat(other), strict=True)), field.name
        else:
            assert one == other, field.name


def old_checkpoint(run: TrainingRun) -> dict[str, Any]:
    """What the code before snapshots stored, key by key."""
    exp_avg, exp_avg_sq = run.engine.moments()
    assert run.poses is not None
    return {
        "format": 1,
        "parameters": run.engine.parameters(),
        "exp_avg": exp_avg,
        "exp_avg_sq": exp_avg_sq,
        "step": 120,
        "seconds": 3.5,
        "rows": [
            {
                "seconds": 1.25, "step": 40, "loss": 0.2, "psnr": 15.5, "ssim": 0.5, "gaussians": 1173,
                "memory": 10**9, "train_psnr": 16.0, "train_ssim": 0.55,
            },
            {"seconds": 2.5, "step": 80, "loss": 0.1, "psnr": None, "ssim": None, "gaussians": 1200},
        ],
        "recoveries": 1,
        "rate_scale": 0.5,
        "order": [4, 7, 1],
        "random": torch.Generator().manual_seed(11).get_state(),
        "views": [view.name for view in run.views],
        "exposure": {"affine": torch.eye(3, 4).repeat(len(run.views), 1, 1)},  # fitted then, and read no more
        "poses": run.poses.state(),
        "budget": {"steps": 180, "seconds": None},
        "shortened": True,
        "most": 3000,
        "ever_saw": True,
    }  # fmt: skip


@pytest.mark.slow
def test_a_checkpoint_of_the_code_before_snapshots_is_resumed(tmp_path: Path) -> None:
    stored = old_checkpoint(advanced(a_run(course()), 120))
    torch.save(stored, tmp_path / "checkpoint.pt")
    snapshot = checkpoint.load(tmp_path)
    assert snapshot is not None
    run = a_run(course())
    run.resume(snapshot)
    assert (run.state.step, run.state.recoveries, run.state.rate_scale, run.state.max_gaussians) == (
        120,
        1,
        0.5,
        3000,
    )
    assert (run.state.shortened, run.state.ever_visible, run.state.upcoming) == (True, True, (4, 7, 1))
    assert not run.state.limited
    assert run.state.budget.steps == 180
    assert run.clock.seconds == pytest.approx(3.5, abs=0.5)
    assert [point.step for point in run.state.curve] == [40, 80]
    assert run.state.curve[0].train_psnr == 16.0
    assert run.state.curve[1].memory is None
    held = run.snapshot()
    assert torch.equal(held.random, stored["random"])
    for name in ("parameters", "exp_avg", "exp_avg_sq", "poses"):
        pairs = zip(flat(getattr(held, name)), flat(stored[name]), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs), name
    advanced(run, 60)
    assert run.state.step == 180
    assert run.progress == 1.0
    assert bool(torch.isfinite(run.engine.parameters()["means"]).all())


@pytest.mark.slow
def test_the_file_has_the_keys_of_its_format(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, advanced(a_run(course()), 3).snapshot())
    stored = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert set(stored) == FILE_KEYS
    assert stored["format"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_a_stored_snapshot_is_the_same_when_it_is_loaded(tmp_path: Path) -> None:
    run = advanced(a_run(course()), 30)
    run.state.limited = True
    snapshot = run.snapshot()
    checkpoint.save(tmp_path, snapshot)
    loaded = checkpoint.load(tmp_path)
    assert loaded is not None
    same(loaded, snapshot, but={"lowest_loss"})


def test_a_resumed_run_takes_the_steps_of_one_that_was_not_interrupted() -> None:
    """Up to the first densification after the interruption: the scores that it reads start anew."""
    whole = replace(course(), densify=False)
    straight = advanced(a_run(whole), 50)
    resumed = a_run(whole)
    resumed.resume(advanced(a_run(whole), 30).snapshot())
    advanced(resumed, 20)
    same(resumed.snapshot(), straight.snapshot(), but={"seconds", "lowest_loss"})


def test_a_roll_back_restores_what_is_optimised_and_nothing_else() -> None:
    run = advanced(a_run(replace(course(), densify=False)), 60)
    good, before = run.last_good, run.snapshot()
    assert good is not None
    assert good.state.step < 60
    run.roll_back(TrainingFailed(FailureName.divergence, "the loss rose.", step=60))
    after = run.snapshot()
    optimised = {"parameters", "exp_avg", "exp_avg_sq", "poses"}
    others = {field.name for field in fields(Snapshot)} - optimised
    same(after, good, but=others)
    same(after, before, but=optimised | {"seconds", "state", "lowest_loss"})
    assert after.state == replace(before.state, recoveries=1, rate_scale=0.5)
    assert after.lowest_loss == good.lowest_loss


def test_after_a_shortage_of_memory_the_most_opaque_gaussians_are_kept() -> None:
    run = advanced(a_run(replace(course(), densify=False)), 10)
    count = run.engine.count
    run.roll_back(TrainingFailed(FailureName.memory, "no room.", step=10))
    assert run.state.max_gaussians == run.engine.count == int(0.8 * count)
    assert run.state.rate_scale == 1.0
    good = run.last_good
    assert good is not None
    assert good.exp_avg.shape[0] == good.exp_avg_sq.shape[0] == int(0.8 * count)


@pytest.mark.parametrize("spoil", ["format", "key", "cut", "text"])
def test_what_this_version_cannot_read_is_no_checkpoint(tmp_path: Path, spoil: str) -> None:
    path = tmp_path / "checkpoint.pt"
    stored = old_checkpoint(a_run(course()))
    if spoil == "format":
        stored["format"] = 2
    if spoil == "key":
        del stored["most"]
    torch.save(stored, path)
    if spoil == "cut":
        path.write_bytes(path.read_bytes()[:-1000])
    if spoil == "text":
        path.write_text("no checkpoint")
    assert checkpoint.load(tmp_path) is None
    assert checkpoint.load(tmp_path / "nowhere") is None


def test_a_checkpoint_that_the_disk_does_not_take_is_an_error_of_the_disk_and_keeps_the_last_one(
    tmp_path: Path,
) -> None:
    run = a_run(course())
    checkpoint.save(tmp_path, run.snapshot())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            checkpoint.save(tmp_path, run.snapshot())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoint.load(tmp_path) is not None
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]


@pytest.mark.parametrize("damage", [b"", b"not a checkpoint", b"PK"])
def test_a_checkpoint_that_is_not_readable_is_left_out_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: bytes
) -> None:
    (tmp_path / checkpoint.NAME).write_bytes(damage)
    assert checkpoint.load(tmp_path) is None
    assert "The checkpoint cannot be used" in caplog.text
    torch.save({"format": 2}, tmp_path / checkpoint.NAME)
    assert checkpoint.load(tmp_path) is None
    assert "it has format 2, and this version reads 1" in caplog.text
