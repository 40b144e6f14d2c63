"""Which pictures are masks, and of which photos, by their names. Upper and lower case are the same in all rules.

A mask lies in a folder of MASK_FOLDERS, at any depth, or beside its photo. In such a folder it has the name of its
photo with another suffix or with one added, or one of the forms that it has beside its photo:

    photo       masks beside it
    a.jpg       a.jpg.png  a_mask.png  a.mask.png  a-mask.png  mask_a.png  mask-a.png  a.jpg_mask.png  a.jpg.mask.png
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from os.path import splitext

from splatmill.schema.files.photos import MASK_SUFFIXES

MASK_FOLDERS = ("masks", "mask", "segmentation", "segmentations")
"""Names, in lower case, of folders that hold masks."""

MASK_ENDINGS = ("_mask", ".mask", "-mask")
"""What follows the name of the photo, with or without its suffix, in the name of a mask."""

MASK_BEGINNINGS = ("mask_", "mask-")
"""What precedes the name of the photo in the name of a mask."""


def without_mask_folder(name: str) -> str | None:
    """Return the path `name` without the folder of masks in it; None where it lies in none, or is no picture."""
    *folders, last = name.split("/")
    if splitext(last)[1].lower() not in MASK_SUFFIXES:
        return None
    for index, folder in enumerate(folders):
        if folder.lower() in MASK_FOLDERS:
            return "/".join([*folders[:index], *folders[index + 1 :], last])
    return None


def masks_beside(names: Collection[str]) -> set[str]:
    """Return those of the pictures `names` that are masks of others. One without a photo of its name is a photo."""
    known = {name.lower() for name in names} | {splitext(name)[0].lower() for name in names}
    whole = {name.lower() for name in names}
    masks = set()
    for name in names:
        stem, suffix = splitext(name)
        if suffix.lower() in MASK_SUFFIXES:
            forms = [form.lower() for form in _unmarked(stem)]
            if stem.lower() in whole or any(form in known for form in forms):
                masks.add(name)
    return masks


def paired(photos: Collection[str], masks: Iterable[str]) -> dict[str, str]:
    """Return the mask of each photo that has one.

    masks: relative to the folder of masks, or as they lie beside the photos.

    Of several masks, one in the same case of letters comes first, then one named like the photo alone, then the order
    of MASK_SUFFIXES. Where the folders differ, a file name that only one photo and one mask have is enough.
    """
    forms: dict[str, list[tuple[int, int, str, str]]] = {}
    for mask in sorted(masks):
        stem, suffix = splitext(mask)
        if suffix.lower() not in MASK_SUFFIXES:
            continue
        order = MASK_SUFFIXES.index(suffix.lower())
        for rank, form in enumerate((stem, *_unmarked(stem))):
            forms.setdefault(form.lower(), []).append((min(rank, 1), order, form, mask))
    pairs = {}
    for photo in photos:
        names = (photo, splitext(photo)[0])
        choices = [
            (form not in names, rank, order, index, mask)
            for index, name in enumerate(names)
            for rank, order, form, mask in forms.get(name.lower(), ())
        ]
        if choices:
            pairs[photo] = min(choices)[-1]
    used = set(pairs.values())
    left = [mask for choices in forms.values() for *_, mask in choices if mask not in used]
    rest = [photo for photo in photos if photo not in pairs]
    if left and rest and any("/" in name for name in (*left, *rest)):
        pairs |= _in_other_folders(photos, rest, sorted(set(left)))
    return pairs


def _in_other_folders(photos: Collection[str], rest: list[str], masks: list[str]) -> dict[str, str]:
    """The masks of the photos `rest` by file name alone, where one photo and one mask have it."""
    last = {photo: photo.rpartition("/")[2] for photo in photos}
    often = Counter(splitext(name)[0].lower() for name in last.values())
    mask_often = Counter(mask.rpartition("/")[2].lower() for mask in masks)
    single = {
        mask.rpartition("/")[2]: mask for mask in masks if mask_often[mask.rpartition("/")[2].lower()] == 1
    }
    alone = {last[photo]: photo for photo in rest if often[splitext(last[photo])[0].lower()] == 1}
    return {alone[name]: single[mask] for name, mask in paired(list(alone), single).items()}


def _unmarked(stem: str) -> list[str]:
    """The names of the photos, with or without suffix, that a mask of this name without its suffix may belong to."""
    folder, slash, last = stem.rpartition("/")
    lower = last.lower()
    names = [last[: -len(end)] for end in MASK_ENDINGS if lower.endswith(end) and lower != end]
    names += [last[len(start) :] for start in MASK_BEGINNINGS if lower.startswith(start) and lower != start]
    return [f"{folder}{slash}{name}" for name in names]
