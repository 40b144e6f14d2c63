"""Processes that share a plan's folder: one runs a unit at a time, an output appears whole, and nothing that a killed
or frozen process leaves stops the others.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from splatmill.process import ProcessIdentity
from splatmill.schema import TrainOptions
from splatmill_worker.errors import Refusal
from splatmill_worker.tiles.folder import CLAIM_SECONDS, Claimed, PlanFolder, digest_of
from splatmill_worker.tiles.units import ScenePlan
from tests.support.waiting import gone, wait_for


@pytest.fixture
def shared(tmp_path: Path) -> PlanFolder:
    made = PlanFolder(tmp_path / "plan", ScenePlan("d", TrainOptions(tiles=2)))
    made.save()
    return PlanFolder.open(tmp_path / "plan")


def do(shared: PlanFolder, name: str, text: str = "x") -> None:
    with shared.claimed(name) as run:
        run.out.mkdir()
        (run.out / "file").write_text(text)
        run.publish({"seconds": 1.0})


def claim_of(shared: PlanFolder) -> Path:
    (claim,) = (shared.root / "units").glob("*.claim")
    return claim


def make_old(claim: Path) -> None:
    """Let a claim be as old as that of a machine that went away."""
    then = time.time() - CLAIM_SECONDS - 5
    os.utime(claim, (then, then))


def test_units_end_in_their_order_and_leave_only_outputs(shared: PlanFolder) -> None:
    assert shared.ended() == {}
    names = [unit.name for unit in shared.plan.units]
    for name in names:
        assert name in shared.plan.ready(shared.states())
        do(shared, name)
    assert set(shared.states().values()) == {"done"}
    left = {path.name.rpartition("-")[0] for path in (shared.root / "units").iterdir()}
    assert left == set(names)
    assert len(list((shared.root / "units").iterdir())) == len(names)


def test_a_unit_that_another_process_runs_is_claimed(shared: PlanFolder) -> None:
    with shared.claimed("cameras") as run:
        assert shared.running("cameras") == f"{os.uname().nodename}, process {os.getpid()}"
        with pytest.raises(Claimed), shared.claimed("cameras"):
            pass
        assert run.held()
    assert shared.running("cameras") is None
    with shared.claimed("cameras"):
        pass


def test_a_claim_of_a_killed_process_of_this_machine_is_free_at_once(shared: PlanFolder) -> None:
    code = (
        "import os, sys; from pathlib import Path; from splatmill_worker.tiles.folder import PlanFolder\n"
        "with PlanFolder.open(Path(sys.argv[1])).claimed('cameras') as run:\n"
        "    (run.work / 'half').write_text('x'); os.kill(os.getpid(), 9)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(shared.root)]) as killed:
        wait_for(lambda: gone([killed.pid]))  # its parent has not read its status yet
        assert claim_of(shared).exists()
        assert shared.running("cameras") is None
        do(shared, "cameras")
    assert killed.returncode == -9
    assert len(list((shared.root / "units").iterdir())) == 1


@pytest.mark.parametrize(
    "elsewhere",
    [
        {"machine": "m"},
        {"boot": "b"},  # a machine with the same name
        {"namespace": "n"},
        {"machine": "", "boot": "", "namespace": ""},
    ],
)
def test_a_claim_of_another_machine_holds_while_it_is_renewed(
    shared: PlanFolder, elsewhere: dict[str, Any]
) -> None:
    (shared.root / "units").mkdir()
    claim = shared.root / "units" / f"cameras-{shared.plan.key('cameras', {})}.claim"
    process = replace(ProcessIdentity.of(os.getpid()), **elsewhere, started="0")
    claim.write_text(json.dumps({"token": "t", "host": "elsewhere", **process.dump()}))
    with pytest.raises(Claimed):
        do(shared, "cameras")
    assert shared.running("cameras") == f"elsewhere, process {os.getpid()}"
    make_old(claim)
    assert shared.running("cameras") is None
    do(shared, "cameras")


def test_a_frozen_process_loses_its_unit_and_changes_nothing_afterwards(shared: PlanFolder) -> None:
    with PlanFolder(shared.root, shared.plan, beat_seconds=1e6).claimed("cameras") as frozen:
        make_old(claim_of(shared))
        frozen.out.mkdir()
        (frozen.out / "file").write_text("late")
        with shared.claimed("cameras") as other:
            assert not frozen.work.exists()  # what the frozen one had is gone, so that it cannot go on
            other.out.mkdir()
            (other.out / "file").write_text("other")
            other.publish({"seconds": 1.0})
        assert not frozen.owned()
        frozen.fail("It came late.", "")
        with pytest.raises(OSError, match="work"):
            frozen.publish({})
    path = shared.ended()["cameras"].path
    assert path is not None
    assert (path / "file").read_text() == "other"
    assert not list(path.parent.glob("*.failed.json"))


def test_of_two_that_find_a_stale_claim_one_gets_the_unit(shared: PlanFolder) -> None:
    """The second judged the claim stale before the first took it: what it then moves aside is the first one's."""
    with shared.claimed("cameras") as first:
        claim = claim_of(shared)
        taken = claim.read_text()
        claim.write_text(json.dumps({"token": "gone"}))

        class Slow(PlanFolder):
            def _age(self, claim: Path) -> float:
                claim.write_text(taken)
                return CLAIM_SECONDS + 1.0

        with pytest.raises(Claimed), Slow(shared.root, shared.plan).claimed("cameras"):
            pass
        assert first.owned()
        assert first.work.is_dir()
        assert claim.read_text() == taken


def test_a_process_notices_that_its_unit_is_anothers(shared: PlanFolder) -> None:
    with PlanFolder(shared.root, shared.plan, beat_seconds=0.05).claimed("cameras") as run:
        claim_of(shared).write_text(json.dumps({"token": "another"}))
        end = time.monotonic() + 20
        while run.held() and time.monotonic() < end:
            time.sleep(0.02)
        assert not run.held()
        run.fail("It failed.", "")
    assert shared.ended() == {}
    assert claim_of(shared).exists()


def test_the_second_of_two_outputs_is_dropped(shared: PlanFolder) -> None:
    with shared.claimed("cameras") as run:
        run.out.mkdir()
        (run.out / "file").write_text("second")
        run.path.mkdir()
        (run.path / "file").write_text("first")
        (run.path / "done.json").write_text("{}")
        run.publish({})
    path = shared.ended()["cameras"].path
    assert path is not None
    assert (path / "file").read_text() == "first"


def test_a_failure_is_kept_until_it_is_forgotten(shared: PlanFolder) -> None:
    do(shared, "photos")
    do(shared, "cameras")
    do(shared, "coarse")
    do(shared, "tile-2")
    with shared.claimed("tile-1") as run:
        run.fail("Training diverged.", "Try another seed.")
    ended = shared.ended()["tile-1"]
    assert (ended.state, ended.failure, ended.advice) == ("failed", "Training diverged.", "Try another seed.")
    assert shared.plan.ready(shared.states()) == ["seam-1", "seam-2"]
    do(shared, "seam-1")
    do(shared, "seam-2")
    assert shared.plan.ready(shared.states()) == ["scene"]
    do(shared, "scene", "partial")
    partial = shared.ended()["scene"].path
    shared.forget_failures("tile-1")
    assert shared.plan.ready(shared.states()) == ["tile-1"]
    do(shared, "tile-1")
    assert shared.plan.ready(shared.states()) == ["seam-1", "seam-2"]
    do(shared, "seam-1")
    do(shared, "seam-2")
    do(shared, "scene", "whole")
    whole = shared.ended()["scene"].path
    assert whole is not None
    assert whole != partial
    assert (whole / "file").read_text() == "whole"


def test_a_digest_follows_from_names_and_contents(tmp_path: Path) -> None:
    def digest(files: dict[str, str]) -> str:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text)
        return digest_of(root)

    one = digest({"images/a": "1", "images/b": "2"})
    assert digest({"images/b": "2", "images/a": "1"}) == one
    assert (
        len({one, digest({"images/a": "2", "images/b": "1"}), digest({"images/a": "1", "images/c": "2"})})
        == 3
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [(None, "has no plan.json"), ("{", "not a plan"), ("[]", "not a plan"), ('{"format": 99}', "format 99")],
)
def test_a_folder_without_a_plan_is_refused(tmp_path: Path, text: str | None, said: str) -> None:
    if text is not None:
        (tmp_path / "plan.json").write_text(text)
    with pytest.raises(Refusal, match=said):
        PlanFolder.open(tmp_path)


def test_failures_that_followed_from_failures_are_forgotten_with_them(shared: PlanFolder) -> None:
    def fail(name: str) -> None:
        with shared.claimed(name) as run:
            run.fail("It diverged.", "")

    for name in ("photos", "cameras", "coarse", "tile-2"):
        do(shared, name)
    fail("tile-1")
    fail("seam-2")
    shared.forget_failures(*shared.plan.part_names)
    fail("tile-1")
    assert shared.plan.ready(shared.states()) == ["seam-1", "seam-2"]


def test_a_plan_of_the_most_tiles_makes_its_units_once_and_has_its_states(tmp_path: Path) -> None:
    options = TrainOptions.model_validate({"tiles": 1024})
    many = PlanFolder(tmp_path, ScenePlan("d", options))
    assert many.plan.units is many.plan.units
    for name in ("photos", "cameras", "coarse", *many.plan.tile_names[:-1]):
        path = many.root / "units" / f"{name}-{many.plan.key(name, {})}"
        path.mkdir(parents=True)
        (path / "done.json").write_text("{}")
    assert len(many.states()) == 1026
    assert many.plan.ready(many.states()) == ["tile-1024"]
