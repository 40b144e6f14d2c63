"""Masks of a capture: used whatever program named them, counted, measured, questioned, and named where none is used.

Does not prove that hidden pixels stay out of the training; the tests of loading photos do.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.errors import SfmFailed
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.sfm import posed

SIZE = (64, 48)


def photo(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)
    Image.fromarray(noise).save(path)


def mask(path: Path, hidden: float) -> None:
    """A mask whose left columns, this share of them, are black."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    columns[:, : round(hidden * SIZE[0])] = 0
    Image.fromarray(columns).save(path)


def prepared(folder: Path, masks: str | None = None) -> Prepared:
    return prepare(folder / "images", folder / masks if masks else None, folder / "work")


@pytest.mark.parametrize(
    "form", ["images/{}_mask.png", "images/{}.mask.png", "images/MASK_{}.png", "images/Masks/{}.PNG"]
)
def test_masks_among_the_photos_are_used_and_counted(tmp_path: Path, form: str) -> None:
    for number in range(4):
        photo(tmp_path / f"images/{number}.png", number)
        if number:
            mask(tmp_path / form.format(number), 0.25)
    found = prepared(tmp_path)
    assert [one.name for one in found.photos] == [f"{number}.png" for number in range(4)]
    assert [one.mask for one in found.photos] == [
        None,
        *(tmp_path / form.format(number) for number in (1, 2, 3)),
    ]
    assert found.skipped == ()
    assert found.notes == ("3 of 4 photos have a mask; the masks hide 25% of their pixels.",)
    assert found.warnings == ()


def test_masks_with_other_suffixes_in_their_folder(tmp_path: Path) -> None:
    for number in range(2):
        photo(tmp_path / f"images/{number}.jpg", number)
        mask(tmp_path / f"masks/{number}.PNG", 0.5)
    assert all(one.mask is not None for one in prepared(tmp_path, "masks").photos)


def test_masks_that_hide_most_are_questioned(tmp_path: Path) -> None:
    for number in range(4):
        photo(tmp_path / f"images/{number}.jpg", number)
        mask(tmp_path / f"masks/{number}.png", 0.875)
    assert prepared(tmp_path, "masks").warnings == (
        "The masks of 4 of 4 photos hide 88% of their pixels. Black hides, and white is trained on: if the masks show "
        "in white what they should hide, invert them.",
    )
    for number in range(2):
        (tmp_path / f"masks/{number}.png").unlink()
    assert prepared(tmp_path, "masks").warnings == ()  # less than half of everything


def test_a_mask_without_its_photo_is_named(tmp_path: Path) -> None:
    for number in range(2):
        photo(tmp_path / f"images/{number}.jpg", number)
    mask(tmp_path / "masks/1.png", 0.25)
    mask(tmp_path / "masks/7.png", 0.25)
    assert prepared(tmp_path, "masks").warnings == (
        "1 mask belongs to no photo by name, and no use is made of it: 7.png.",
    )


@pytest.mark.parametrize("place", ["masks/{}.PNG", "Mask/{}.png", "images/{}_mask.png", "images/mask_{}.png"])
def test_masks_of_photos_with_cameras(tmp_path: Path, place: str) -> None:
    frames = []
    for number in range(3):
        photo(tmp_path / f"images/{number}.jpg", number)
        mask(tmp_path / place.format(number), 0.875)
        frames.append({"file_path": f"images/{number}.jpg", "transform_matrix": np.eye(4).tolist()})
    mask(tmp_path / "masks/other.png", 0.25)
    document = {"fl_x": 60.0, "w": SIZE[0], "h": SIZE[1], "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    given = posed.find(tmp_path)
    assert given is not None
    scene = given.load()
    assert [view.mask for view in scene.views] == [tmp_path / place.format(number) for number in range(3)]
    assert scene.left_out == ()
    assert "3 of 3 photos have a mask; the masks hide 88% of their pixels." in scene.notes
    assert [text.split(":")[0] for text in scene.warnings] == [
        "1 mask belongs to no photo by name, and no use is made of it",
        "The masks of 3 of 3 photos hide 88% of their pixels. Black hides, and white is trained on",
    ]


def test_a_failure_names_what_is_wrong_with_the_masks(tmp_path: Path) -> None:
    photo(tmp_path / "images/0.jpg", 0)
    mask(tmp_path / "masks/7.png", 0.25)
    options = sfm.SfmOptions()
    with pytest.raises(
        SfmFailed, match=r"belongs to no photo by name, and no use is made of it: 7\.png"
    ) as failed:
        sfm.reconstruct(
            tmp_path / "images",
            tmp_path / "masks",
            tmp_path / "work",
            options,
            lambda *_: None,
            lambda: False,
        )
    assert failed.value.code == "too_few_images"
