"""What the masks of a capture hide, by the levels that occur in all of them together."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from splatmill.schema.quantities import counted, listed
from splatmill_worker.errors import Refusal, UnusablePicture
from splatmill_worker.images.decoding import decoders
from splatmill_worker.scene import MIN_SHOWN

MAX_HIDDEN = 0.5
"""Share of the pixels of all photos that masks may hide without a warning."""

MAX_BETWEEN = 0.25
"""Share of the pixels of masks that may lie between black and white, as soft edges do; of pictures, most do."""

BETWEEN = range(32, 224)
"""Levels that are neither black nor white."""

MOST_LEVELS = 32
"""Levels between black and white that masks may have, as pictures of labels do, however many pixels have them."""


@dataclass(frozen=True)
class Judged:
    """The masks of a capture.

    shown_from: level of all masks, 0 to 255, from which a pixel is shown.
    notes, warnings: sentences for the user.
    """

    shown_from: int
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def judged(masks: Mapping[str, Path | None], unused: Collection[str]) -> Judged:
    """Measure the masks of photos.

    Levels under MIN_SHOWN hide. Where all masks together have two levels, both under it or both not, as pictures of
    labels 0 and 1 have, the lower one hides and the higher one shows.

    masks: of each photo, by its name; None where it has none.
    unused: names of the masks that belong to no photo.

    Raises Refusal where the masks hide all pixels of every photo, and where they are pictures, such as previews of
    masks over the photos. A mask that does not decode is not measured: it ends the loading of photos.
    """
    warnings = _unused(unused)
    own = {name: mask for name, mask in masks.items() if mask is not None}
    with ThreadPoolExecutor() as pool:
        measured = zip(own, pool.map(_levels, own.values()), strict=True)
        counts = {name: levels for name, levels in measured if levels is not None}
    present = [level for level in range(256) if any(levels[level] for levels in counts.values())]
    _check_masks(counts, present)
    shown_from = MIN_SHOWN
    if len(present) == 2 and (present[1] < MIN_SHOWN or present[0] >= MIN_SHOWN):
        hides, shown_from = present
        warnings.append(
            f"The masks have the levels {hides} and {shown_from} of 255 alone, as pictures of labels have. {hides} is "
            f"taken to hide, and {shown_from} to show what is trained on: if it is the other way round, invert them."
        )
    shares = {name: sum(levels[:shown_from]) / sum(levels) for name, levels in counts.items()}
    hidden = [name for name, share in shares.items() if share == 1]
    if masks and len(hidden) == len(masks):
        span = str(present[0]) if len(present) == 1 else f"{present[0]} to {present[-1]}"
        raise Refusal(
            "no_images",
            f"The masks hide all pixels of all {len(masks)} photos: their levels are {span} of 255, and those under "
            f"{MIN_SHOWN} hide.",
            advice="Draw in white (255) what is trained on, and in black (0) what is hidden, or leave the masks out.",
        )
    if hidden:
        which = counted(len(hidden), "mask hides", "masks hide")
        warnings.append(f"{which} all of a photo: {listed(sorted(hidden))}.")
    if not shares:
        return Judged(shown_from, (), tuple(warnings))
    share = sum(shares.values()) / len(shares)
    if share * len(own) > MAX_HIDDEN * len(masks):
        warnings.append(
            f"The masks of {len(own)} of {len(masks)} photos hide {share:.0%} of their pixels. Black hides, and "
            "white is trained on: if the masks show in white what they should hide, invert them."
        )
    note = f"{len(own)} of {len(masks)} photos have a mask; the masks hide {share:.0%} of their pixels."
    return Judged(shown_from, (note,), tuple(warnings))


def _check_masks(counts: Mapping[str, list[int]], present: Collection[int]) -> None:
    """Raise Refusal where masks are pictures by their levels. counts: pixels of each level, by the names of photos."""
    between = {name: sum(levels[level] for level in BETWEEN) / sum(levels) for name, levels in counts.items()}
    share = sum(between.values()) / max(1, len(between))
    if share <= MAX_BETWEEN or len(set(present).intersection(BETWEEN)) <= MOST_LEVELS:
        return
    raise Refusal(
        "no_images",
        f"The masks of {len(counts)} photos seem to be pictures: {share:.0%} of their pixels are neither black nor "
        f"white, most in that of {max(between, key=lambda name: between[name])}.",
        advice="Draw in white (255) what is trained on, and in black (0) what is hidden, or leave the masks out. If "
        "they are photos, put them beside the others, into a folder of another name.",
    )


def _unused(names: Collection[str]) -> list[str]:
    """A warning about masks that belong to no photo; none where there are none."""
    if not names:
        return []
    belong = counted(len(names), "mask belongs", "masks belong")
    return [f"{belong} to no photo by name, and no use is made of it: {listed(sorted(names))}."]


def _levels(mask: Path) -> list[int] | None:
    try:
        return decoders.mask_levels(mask)
    except (UnusablePicture, OSError):
        return None
