"""Proves that the stages of structure from motion report photos, pairs and adjustments of all cameras, so that no
report waits for more than one of them.

Counts reports, not seconds: how long a photo takes depends on the machine. `bench sfm` has the times.
"""

import re

import pytest

from splatmill_worker import sfm, synthetic

pytestmark = pytest.mark.slow

PHOTOS = 20
Report = tuple[int, int, str]


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Report]]:
    folder = tmp_path_factory.mktemp("progress")
    synthetic.capture(folder / "images", PHOTOS, 320, 240, samples=1)
    stages: dict[str, list[Report]] = {}
    options = sfm.SfmOptions(effort="lean", stereo=False, threads=1)
    scene = sfm.reconstruct(
        folder / "images",
        None,
        folder / "work",
        options,
        lambda stage, *report: stages.setdefault(stage, []).append(report),
        lambda: False,
    )
    stages["placed"] = [(scene.facts["registered"], scene.facts["pairs_matched"], "")]
    return stages


def test_features_are_reported_from_the_first_photo_to_the_last(reports: dict[str, list[Report]]) -> None:
    counts = [done for done, _, _ in reports["features"]]
    assert counts == list(range(1, PHOTOS + 1))


def test_each_photo_is_reported_when_it_is_compared_with_others(reports: dict[str, list[Report]]) -> None:
    notes = [note for _, _, note in reports["images"]]
    assert notes[PHOTOS:] == [f"compared {done} of {PHOTOS} with the others" for done in range(1, PHOTOS + 1)]


def test_each_pair_is_reported(reports: dict[str, list[Report]]) -> None:
    ((_, pairs, _),) = reports["placed"]
    assert len({done for done, _, _ in reports["matching"]}) == pairs
    assert {note for _, _, note in reports["matching"]} == {"pairs matched"}
    assert "pairs" in reports


def test_each_photo_that_is_placed_and_each_adjustment_is_reported(reports: dict[str, list[Report]]) -> None:
    ((placed, _, _),) = reports["placed"]
    assert placed >= PHOTOS - 2
    steps = [done for done, _, note in reports["mapping"] if note == "photos placed"]
    assert set(steps) >= set(range(3, placed + 1))
    assert steps == sorted(steps)
    colors = [note for _, _, note in reports["mapping"] if note.startswith("colours ")]
    assert colors == [f"colours of the points, from {n} of {placed} photos" for n in range(1, placed + 1)]
    adjustments = [note for _, _, note in reports["mapping"] if note.startswith("adjusting ")]
    assert f"adjusting {max(steps)} cameras, pass 1" in adjustments
    last = [note for note in adjustments if "lenses" in note]
    assert last[0] == f"adjusting {placed} cameras and their lenses, iteration 1"
    assert re.fullmatch(r"adjusting \d+ points, iteration \d+", adjustments[-1])
    assert {total for _, total, _ in reports["mapping"]} == {PHOTOS}
