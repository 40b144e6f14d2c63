"""Masks of a capture: used whatever program named them, counted, measured, questioned, and named where none is used.

Does not prove that hidden pixels stay out of the training; the tests of loading photos do.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatmill_worker import sfm
from splatmill_worker.errors import Refusal, SfmFailed
from splatmill_worker.images.load import load_view
from splatmill_worker.images.overlays import overlays
from splatmill_worker.images.prepare import Prepared, prepare
from splatmill_worker.sfm import features, posed
from tests.support.posed_sets import frames, transforms

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
    result = prepared(tmp_path)
    assert [one.name for one in result.photos] == [f"{number}.png" for number in range(4)]
    assert [one.mask for one in result.photos] == [
        None,
        *(tmp_path / form.format(number) for number in (1, 2, 3)),
    ]
    assert result.skipped == ()
    assert result.notes == ("3 of 4 photos have a mask; the masks hide 25% of their pixels.",)
    assert result.warnings == ()


@pytest.mark.parametrize("masked", ["0.png", "0 copy.png"])
def test_of_two_files_of_one_photo_that_with_the_short_name_is_used_with_the_mask_of_either(
    tmp_path: Path, masked: str
) -> None:
    for number in range(3):
        photo(tmp_path / f"images/{number}.png", number)
    shutil.copy(tmp_path / "images/0.png", tmp_path / "images/0 copy.png")
    mask(tmp_path / "masks" / masked, 0.25)
    result = prepared(tmp_path, "masks")
    assert [one.name for one in result.photos] == ["0.png", "1.png", "2.png"]
    assert [one.mask for one in result.photos] == [tmp_path / "masks" / masked, None, None]
    assert result.skipped == (("0 copy.png", "its content is the same as that of 0.png"),)


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


def _drawn(low: int, high: int, mode: str = "L", first_hidden: bool = False) -> Callable[[int], Image.Image]:
    """Makes the mask of each photo, whose left quarter has the lower level; all of the first one, if `first_hidden`."""

    def mask_of(number: int) -> Image.Image:
        levels = np.full((SIZE[1], SIZE[0]), high, np.uint16)
        levels[:, : SIZE[0] // (1 if first_hidden and number == 0 else 4)] = low
        match mode:
            case "I;16":
                return Image.fromarray(levels)
            case "F":
                return Image.fromarray(levels.astype(np.float32))
            case "P":
                indexed = Image.fromarray(levels.astype(np.uint8)).convert("P")
                indexed.putpalette([0, 0, 0, 128, 0, 0])
                return indexed
            case "LA":
                black = Image.new("L", SIZE, 0)
                return Image.merge("LA", [black, Image.fromarray(levels.astype(np.uint8))])
        return Image.fromarray(levels.astype(np.uint8)).convert(mode)

    return mask_of


def _labelled(folder: Path, mask_of: Callable[[int], Image.Image], suffix: str = "png") -> None:
    (folder / "masks").mkdir()
    for number in range(3):
        photo(folder / f"images/{number}.jpg", number)
        mask_of(number).save(folder / f"masks/{number}.{suffix}")
    transforms(folder / "transforms.json", frames(["0.jpg", "1.jpg", "2.jpg"]))


@pytest.mark.parametrize(
    ("mask_of", "suffix", "levels"),
    [
        (_drawn(0, 1), "png", (0, 1)),
        (_drawn(0, 1, first_hidden=True), "png", (0, 1)),
        (_drawn(3, 7), "png", (3, 7)),
        (_drawn(200, 255), "png", (200, 255)),
        (_drawn(0, 1, "P"), "png", (0, 38)),
        (_drawn(0, 1, "I;16"), "png", (0, 1)),
        (_drawn(0, 1, "LA"), "png", (0, 1)),
        (_drawn(0, 255, "LA"), "png", None),
        (_drawn(0, 255, "1"), "png", None),
        (_drawn(0, 65535, "I;16"), "png", None),
        (_drawn(0, 1, "F"), "tif", None),
    ],
)
def test_masks_of_two_labels_show_the_higher_one(
    tmp_path: Path, mask_of: Callable[[int], Image.Image], suffix: str, levels: tuple[int, int] | None
) -> None:
    _labelled(tmp_path, mask_of, suffix)
    named = [] if levels is None else [f"The masks have the levels {levels[0]} and {levels[1]} of 255 alone"]
    named += ["1 mask hides all of a photo"] if mask_of(0).getextrema() == (0, 0) else []
    result = prepared(tmp_path, "masks")
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
    assert [text.split(",")[0].split(":")[0] for text in result.warnings] == named
    assert [text.split(",")[0].split(":")[0] for text in scene.warnings] == named
    for view, one in zip(scene.views, result.photos, strict=True):
        loaded = load_view(view, 64).mask
        assert loaded is not None
        hidden = 64 if len(named) == 2 and view.name == "0.jpg" else 16
        assert not loaded[:, :hidden].any()
        assert loaded[:, hidden:].all()
        _, reduced = features._reduced(one, 64)
        assert reduced is not None
        assert np.array_equal(reduced, np.where(loaded, 255, 0))
        region = np.zeros((6, 8), bool)
        region[:, -1] = True
        path = overlays.mask_file(region, one.mask, tmp_path / "work", shown_from=one.shown_from)
        shown = np.asarray(Image.open(path)) >= 128
        assert np.array_equal(shown[:, :56], loaded[:, :56])
        assert not shown[:, 56:].any()


@pytest.mark.parametrize(("low", "high", "span"), [(0, 0, "0"), (1, 1, "1")])
def test_masks_that_hide_everything_are_refused(tmp_path: Path, low: int, high: int, span: str) -> None:
    _labelled(tmp_path, _drawn(low, high))
    poses = posed.find(tmp_path)
    assert poses is not None
    for load in (poses.load, lambda: prepared(tmp_path, "masks")):
        with pytest.raises(Refusal, match=f"all pixels of all 3 photos: their levels are {span} of 255"):
            load()


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
    for number in range(3):
        photo(tmp_path / f"images/{number}.jpg", number)
        mask(tmp_path / place.format(number), 0.875)
    mask(tmp_path / "masks/other.png", 0.25)
    transforms(tmp_path / "transforms.json", frames(["0.jpg", "1.jpg", "2.jpg"]))
    poses = posed.find(tmp_path)
    assert poses is not None
    scene = poses.load()
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


@pytest.mark.parametrize("posed_too", [False, True])
def test_pictures_in_the_folder_of_masks_are_refused_as_previews_of_masks(
    tmp_path: Path, posed_too: bool
) -> None:
    names = [f"{number}.png" for number in range(4)]
    for number, name in enumerate(names):
        photo(tmp_path / "images" / name, number)
        photo(tmp_path / "masks" / name, number + 10)
    transforms(tmp_path / "transforms.json", frames(names))
    poses = posed.find(tmp_path)
    assert poses is not None
    with pytest.raises(Refusal) as refused:
        poses.load() if posed_too else prepared(tmp_path, "masks")
    assert refused.value.code == "no_images"
    assert "are neither black nor white" in str(refused.value)


def test_masks_with_soft_edges_and_pictures_of_grey_labels_are_used(tmp_path: Path) -> None:
    soft = np.tile(np.clip(np.arange(64) * 32 - 600, 0, 255).astype(np.uint8), (48, 1))
    labels = np.repeat(np.arange(0, 256, 32, dtype=np.uint8), 8)[None].repeat(48, axis=0)
    for number, levels in enumerate((soft, soft, labels)):
        photo(tmp_path / f"images/{number}.png", number)
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(levels).save(tmp_path / f"masks/{number}.png")
    assert all(one.mask is not None for one in prepared(tmp_path, "masks").photos)
