"""Proves that each photo has one camera and one part of its data set, whatever number of files and lists name it.

Not proven here: single files (test_posed), and cameras of the raw data of Polycam with its photos (test_layouts).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from splatmill_worker.scene import split
from tests.support.posed_sets import (
    ALL,
    COUNT,
    NAMES,
    check,
    frames,
    image_lines,
    loaded,
    model,
    photos,
    transforms,
)


def moved(of: list[dict[str, Any]], *numbers: int) -> list[dict[str, Any]]:
    """Frames with other places for some of them."""
    copy = json.loads(json.dumps(of))
    for number in numbers:
        copy[number]["transform_matrix"][0][3] += 0.5
    return list(copy)


def test_the_parts_beside_transforms_json_are_followed(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    transforms(tmp_path / "transforms.json", frames()[:8])
    transforms(tmp_path / "transforms_test.json", frames()[6:10])
    transforms(tmp_path / "transforms_val.json", frames()[:1] + frames()[10:])
    transforms(tmp_path / "transforms_old.json", moved(frames(), *range(COUNT)))
    scene = loaded(tmp_path)
    assert scene.source == "transforms"
    check(scene, {name: k for name, k in ALL.items() if 0 < k < 10})
    train, test = split(scene)
    assert [view.name for view in train] == NAMES[1:6]
    assert [view.name for view in test] == NAMES[6:10]
    assert dict(scene.left_out) == dict.fromkeys([NAMES[0], *NAMES[10:]], "validation sets are not used")
    assert scene.warnings == ("Not used beside transforms.json: transforms_old.json.",)


def test_lists_of_photos_are_followed(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    names = [f"images/{name}" for name in NAMES]
    lists = {"train": names[:9], "test": [f"./{name}" for name in names[8:10]], "val": names[9:]}
    lists["test"].append("images/gone.jpg")
    document: dict[str, Any] = {f"{part}_filenames": some for part, some in lists.items()}
    document |= {"fl_x": 60, "fl_y": 61, "w": 64, "h": 48, "frames": frames()}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    scene = loaded(tmp_path)
    train, test = split(scene)
    assert [view.name for view in train] == NAMES[:8]
    assert [view.name for view in test] == NAMES[8:10]
    assert [name for name, _ in scene.left_out] == NAMES[10:]
    assert "1 name that no frame has, such as 'images/gone.jpg'" in scene.warnings[0]
    assert f"1 photo is named both for training and for holding out, such as {NAMES[8]}" in scene.warnings[1]


@pytest.mark.parametrize("form", ["one file", "two files", "images.txt", "two names"])
@pytest.mark.parametrize("others", [(), (3,), (3, 5)])
def test_a_photo_named_twice_has_one_camera(tmp_path: Path, form: str, others: tuple[int, ...]) -> None:
    """The same camera twice is one; of one photo in twelve with two, both are named; of more, none is used."""
    photos(tmp_path / "images")
    if form in ("one file", "two files"):
        again = moved(frames(), *others)
        transforms(tmp_path / "transforms.json", frames() + (again if form == "one file" else []))
        if form == "two files":
            transforms(tmp_path / "transforms_train.json", again)
    else:
        model(tmp_path / "sparse/0")
        images = tmp_path / "sparse/0/images.txt"
        again_as = "{}" if form == "images.txt" else "other/{}"
        for line in image_lines({k: again_as.format(name) for k, name in enumerate(NAMES)}):
            number, w, x, y, z, tx, *rest = line.split(" ", 8)
            shift = 0.5 if int(number) - 1 in others else 0.0
            row = [str(int(number) + 100), w, x, y, z, str(float(tx) + shift), *rest]
            images.write_text(images.read_text() + " ".join(row) + "\n\n")
    if len(others) < 2:
        scene = loaded(tmp_path)
        check(scene, {name: k for name, k in ALL.items() if k not in others})
        assert len(scene.views) == COUNT - len(others)
        assert [name for name, _ in scene.left_out] == [NAMES[k] for k in others]
        assert all("has it at (" in reason and ", and " in reason for _, reason in scene.left_out)
        return
    with pytest.raises(
        ValueError, match=f"for 2 of 12 photos, such as {NAMES[3]}: .* has it at .* has it at"
    ):
        loaded(tmp_path)


def test_cameras_of_another_kind_beside_those_that_are_used_are_named(tmp_path: Path) -> None:
    photos(tmp_path / "images")
    model(tmp_path / "poses/sparse/0")
    transforms(tmp_path / "poses/transforms.json")
    (tmp_path / "poses/keyframes/cameras").mkdir(parents=True)
    (tmp_path / "poses/keyframes/cameras/1.json").write_text("{}")
    said = "The cameras in sparse/0/ are used, not those in keyframes/cameras/, transforms.json."
    assert loaded(tmp_path).warnings == (said,)
