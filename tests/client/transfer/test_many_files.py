"""Finding the files of a capture, and pairing photos with masks, takes time that grows with the number of files and not
with its square. Does not prove how long it takes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from splatmill.schema.files.masks import masks_beside, paired
from splatmill.schema.files.other_pictures import beside_photos
from splatmill.schema.files.outputs import own_outputs
from splatmill.schema.files.photos import unread
from splatmill.transfer.local_capture import find_files

FEW, MANY = 1250, 5000

MOST_GROWTH = 8.0
"""Of the time, for four times the files: 4 where it is in proportion, 16 where each is compared with all."""


def seconds(work: Callable[[], object]) -> float:
    """CPU seconds of the fastest of three runs."""
    times = []
    for _ in range(3):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def photos(count: int) -> list[str]:
    return [f"set/images/IMG_{index:05d}.JPG" for index in range(count)]


def marked(count: int) -> list[str]:
    return [f"set/images/img_{index:05d}_mask.png" for index in range(count)]


def elsewhere(count: int) -> list[str]:
    return [f"other/masks/IMG_{index:05d}.JPG.png" for index in range(count)]


NAMES: dict[str, Callable[[int], object]] = {
    "masks beside": lambda count: masks_beside([*photos(count), *marked(count)]),
    "pairs": lambda count: paired(photos(count), marked(count)),
    "pairs in other folders": lambda count: paired(photos(count), elsewhere(count)),
    "other pictures": lambda count: beside_photos([*photos(count), *elsewhere(count)]),
    "outputs": lambda count: own_outputs(photos(count)),
    "unread files": lambda count: unread([f"{name}.heif" for name in photos(count)]),
}


@pytest.mark.parametrize("what", list(NAMES))
def test_names(what: str) -> None:
    few, many = (seconds(partial(NAMES[what], count)) for count in (FEW, MANY))
    assert many < MOST_GROWTH * few + 0.005


def test_what_is_paired() -> None:
    pairs = paired(photos(MANY), marked(MANY))
    assert pairs == dict(zip(photos(MANY), marked(MANY), strict=True))
    assert masks_beside([*photos(MANY), *marked(MANY)]) == set(marked(MANY))


@pytest.mark.slow
@pytest.mark.parametrize("posed", [False, True])
def test_a_folder(posed: bool, tmp_path: Path) -> None:
    times = []
    for count in (FEW, MANY):
        folder = tmp_path / str(count)
        for part in ("images", "masks"):
            (folder / part).mkdir(parents=True)
        frames = []
        for index in range(count):
            name, mask = f"images/{index:05d}.jpg", f"masks/{index:05d}.png"
            (folder / name).write_bytes(b"\xff\xd8\xff")
            (folder / mask).write_bytes(b"\x89PNG")
            frames.append({"file_path": name, "mask_path": mask, "transform_matrix": [[1, 0, 0, 0]] * 4})
        if posed:
            (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
        assert len(find_files(folder).files) == 2 * count + posed
        times.append(seconds(partial(find_files, folder)))
    assert times[1] < MOST_GROWTH * times[0]
