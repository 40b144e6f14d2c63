"""Names of masks: each convention of other programs leads to its photo, and a photo without a namesake stays a photo.

Does not prove what a mask hides; the worker's tests of images do.
"""

import pytest

from splatmill.schema import MASK_BEGINNINGS, MASK_ENDINGS, MASK_FOLDERS
from splatmill.schema.files.masks import masks_beside, paired, without_mask_folder


@pytest.mark.parametrize(
    "mask",
    [
        "day/IMG_1.jpg.png",  # COLMAP
        "day/IMG_1_mask.png",  # OpenDroneMap, Metashape
        "day/IMG_1_mask.JPG",
        "day/IMG_1.mask.png",  # OpenMVS, RealityScan
        "day/IMG_1_MASK.PNG",
        "day/img_1_mask.png",
        "day/IMG_1-mask.webp",
        "day/mask_IMG_1.png",
        "day/Mask-IMG_1.png",
        "day/IMG_1.jpg_mask.png",
        "day/IMG_1.JPG.mask.png",
    ],
)
def test_a_mask_beside_its_photo(mask: str) -> None:
    assert masks_beside(["day/IMG_1.jpg", "day/IMG_2.jpg", mask]) == {mask}
    assert paired(["day/IMG_1.jpg", "day/IMG_2.jpg"], [mask]) == {"day/IMG_1.jpg": mask}


@pytest.mark.parametrize(
    "names",
    [
        ["venetian_mask.jpg", "gas_mask.jpg"],
        ["mask_1.jpg", "mask_2.jpg"],
        ["a.jpg", "other/a_mask.png"],
        ["a.jpg", "a.png"],
        ["_mask.png", "mask_.png", ".mask.png", "a.jpg"],
        ["a.jpg", "a_masked.png", "unmask_a.png"],
    ],
)
def test_pictures_that_stay_photos(names: list[str]) -> None:
    assert masks_beside(names) == set()


@pytest.mark.parametrize("folder", ["masks", "mask", "Masks", "MASK", "segmentation", "cam/Masks"])
def test_folders_of_masks(folder: str) -> None:
    above = folder.rpartition("/")[0] + "/" if "/" in folder else ""
    assert without_mask_folder(f"{folder}/left/a.PNG") == f"{above}left/a.PNG"
    assert without_mask_folder(f"{folder}/readme.txt") is None
    assert without_mask_folder("masks.png") is None
    assert without_mask_folder("unmasked/a.png") is None


def test_the_best_of_several_masks() -> None:
    assert paired(["a.jpg"], ["a.tif", "a_mask.png", "a.png"]) == {"a.jpg": "a.png"}
    assert paired(["a.jpg", "A.jpg"], ["a.png", "A.png"]) == {"a.jpg": "a.png", "A.jpg": "A.png"}
    assert paired(["a.jpg", "a.png"], ["a.jpg.png", "a.png.png"]) == {
        "a.jpg": "a.jpg.png",
        "a.png": "a.png.png",
    }


def test_masks_in_other_folders_than_their_photos() -> None:
    assert paired(["left/a.jpg", "right/b.jpg"], ["a.png", "B_mask.PNG"]) == {
        "left/a.jpg": "a.png",
        "right/b.jpg": "B_mask.PNG",
    }
    assert paired(["a.jpg"], ["day/a.png"]) == {"a.jpg": "day/a.png"}
    # Which of the two photos it belongs to cannot be known.
    assert paired(["left/a.jpg", "right/a.jpg"], ["a.png"]) == {}
    assert paired(["a.jpg"], ["left/a.png", "right/a.png"]) == {}


def test_the_table_is_in_lower_case() -> None:
    for text in (*MASK_FOLDERS, *MASK_ENDINGS, *MASK_BEGINNINGS):
        assert text == text.lower()
