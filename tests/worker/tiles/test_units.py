"""What is ready follows from the plan and from what has ended, in any order, and keys follow from what matters."""

from __future__ import annotations

import random

import pytest

from splatmill.backplane.queue.entries import UNITS_PER_TILE
from splatmill.schema import TrainOptions
from splatmill_worker.tiles.units import CAMERA_OPTIONS, ScenePlan, State


def plan(tiles: int = 4, digest: str = "d", **options: object) -> ScenePlan:
    return ScenePlan(digest, TrainOptions.model_validate(options | {"tiles": tiles}))


@pytest.mark.parametrize("seed", range(50))
def test_a_walk_in_any_order_ends_with_the_scene_unless_what_it_needs_failed(seed: int) -> None:
    choose = random.Random(seed)
    scene = plan(choose.randint(2, 9))
    states: dict[str, State] = {}
    while ready := scene.ready(states):
        for name in ready:
            unit = scene.unit(name)
            assert all(states.get(need) == "done" or need in unit.optional for need in unit.needs)
            assert all(need in states for need in unit.needs)
        name = choose.choice(ready)
        states[name] = "failed" if choose.random() < 0.15 else "done"
    if all(states.get(name) == "done" for name in ("photos", "pairs", "cameras", "coarse")):
        assert set(states) == {unit.name for unit in scene.units}
    else:
        assert "scene" not in states
        assert not any(name.startswith(("tile", "seam")) for name in states)
    assert len(scene.part_names) == UNITS_PER_TILE * scene.tiles


def test_only_what_depends_on_an_option_has_another_key() -> None:
    names = [unit.name for unit in plan().units]

    def changed(other: ScenePlan) -> set[str]:
        return {name for name in names if plan().key(name, {}) != other.key(name, {})}

    assert changed(plan()) == set()
    assert changed(plan(steps=500)) == set(names) - set(plan().camera_names)
    assert changed(plan(tiles=5)) == set(names) - {"photos", "pairs", "cameras"}
    mapped = {"mapping-1", "mapping-2", "mapping-3", "mapping-4"}
    assert changed(plan(mapper="global")) == set(names) - set(plan().camera_names[:-1]) | mapped
    assert changed(plan(sfm_effort="high")) == set(names)
    assert changed(plan(digest="e")) == set(names)
    keys = [plan().key(name, {}) for name in names]
    assert len(set(keys)) == len(keys)


def test_a_scene_without_a_failed_tile_is_another_output() -> None:
    whole = plan().key("scene", {"tile-1": "done", "tile-2": "done"})
    assert plan().key("scene", {"tile-1": "done", "tile-2": "failed"}) != whole
    assert plan().key("scene", {"tile-1": "done"}) == whole
    assert plan().key("scene", {"seam-1": "failed"}) != whole
    assert plan().key("seam-3", {"tile-1": "failed"}) != plan().key("seam-3", {})


def test_what_only_the_cameras_need_is_not_done_once_they_are_there() -> None:
    scene = plan(2)
    assert scene.ready({"cameras": "done"}) == ["photos"]
    assert scene.ready({"cameras": "done", "photos": "done"}) == ["coarse"]
    assert scene.ready({"photos": "done"}) == ["features-1", "features-2"]
    assert scene.pending(dict.fromkeys(("cameras", "coarse"), "done")) == {
        *("photos", "tile-1", "tile-2", "seam-1", "seam-2", "scene")
    }
    assert scene.needed({"cameras": "done", "coarse": "done"}) == {unit.name for unit in scene.units} - set(
        scene.camera_names[1:-1]
    )
    assert scene.needed({}) == {unit.name for unit in scene.units}
    failed: dict[str, State] = {"photos": "done", "features-1": "failed", "features-2": "done"}
    assert scene.ready(failed) == ["pairs"]
    assert scene.key("cameras", failed) == scene.key("cameras", {})
    assert scene.key("pairs", failed) == scene.key("pairs", {})
    assert scene.key("mapping-2", failed) == scene.key("mapping-2", {})
    lost: dict[str, State] = {"matches-1": "failed"}
    assert scene.key("cameras", lost) == scene.key("cameras", {})
    assert scene.key("mapping-2", lost) != scene.key("mapping-2", {}), (
        "nothing is mapped without these matches"
    )


@pytest.mark.parametrize(
    ("clusters", "mapper", "left"), [(0, "auto", 4), (3, "auto", 1), (9, "auto", 0), (3, "global", 4)]
)
def test_mapping_units_without_a_cluster_are_left_out(clusters: int, mapper: str, left: int) -> None:
    scene = plan(4, mapper=mapper)
    facts = {"photos": 250 * clusters, "divided": True, "clusters": clusters}
    assert scene.left_out(facts) == set(scene.mapping_names[4 - left :])
    assert scene.left_out(facts | {"divided": False}) == set(scene.camera_names[1:-1])


def test_options_that_cameras_follow_from_exist_and_a_plan_survives_json() -> None:
    assert set(CAMERA_OPTIONS) <= set(TrainOptions.model_fields)
    scene = plan(7, steps=300, holdout=5)
    assert ScenePlan.from_dict(scene.as_dict()) == scene
    with pytest.raises(ValueError, match="format 99"):
        ScenePlan.from_dict({**scene.as_dict(), "format": 99})
    with pytest.raises(KeyError):
        scene.unit("tile-8")
