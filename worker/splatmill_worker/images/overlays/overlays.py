"""Hides what never moves in the photos of each camera (`overlay`) and what lies round a round picture, and says so."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill.files import replacing
from splatmill_worker.images.copies import SMALL_SIDE, small_grey
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.image_circle import Circle, circle_in, has_dark_corners
from splatmill_worker.images.lens import pinhole, within
from splatmill_worker.images.load import training_size
from splatmill_worker.images.masks import shown_part
from splatmill_worker.images.overlays.overlay import MIN_PHOTOS, still
from splatmill_worker.scene import MIN_SHOWN, Overlay, Scene, View

Region = npt.NDArray[np.bool_]

FRAME_SIDE = 1024
"""Longest side of the mask of what lies round a circle."""

FEWEST_OF_A_CIRCLE, MOST_OF_A_CIRCLE = 3, 16
"""Photos in which a circle is looked for, at least and at most."""

FINER = 2
"""Times the size of the small pictures at which it is looked for."""


@dataclass(frozen=True)
class Candidate:
    """A photo in which something may never move.

    name, width, height: of the photo.
    source: the video or folder that it is from.
    """

    name: str
    width: int
    height: int
    source: str


@dataclass(frozen=True)
class Hidden:
    """What is hidden in the photos.

    regions: of each photo, bool [h,w] at low resolution; None where nothing is.
    circles: of each photo, the circle that its picture fills; None where it fills the photo.
    shown: the same by camera, for the report.
    warnings: sentences for the user.
    """

    regions: tuple[Region | None, ...]
    circles: tuple[Circle | None, ...]
    shown: tuple[Overlay, ...]
    warnings: tuple[str, ...]


def in_views(scene: Scene, workdir: Path) -> Scene:
    """The scene with what never moves in its photos masked; the masks lie in `workdir`.

    Raises as `decoders.decode` does.
    """
    views = scene.views
    hidden = hidden_in(
        [
            Candidate(
                each.name, each.camera.width, each.camera.height, PurePosixPath(each.name).parent.as_posix()
            )
            for each in views
        ],
        lambda index, size: decoders.decode(views[index].image, at_least=size, upright=views[index].upright),
    )
    masked = (
        each
        if region is None
        else replace(
            within_circle(each, circle),
            mask=mask_file(region, each.mask, workdir, upright=each.upright, shown_from=each.shown_from),
            shown_from=MIN_SHOWN,
        )
        for each, region, circle in zip(views, hidden.regions, hidden.circles, strict=True)
    )
    return replace(
        scene, views=tuple(masked), warnings=(*scene.warnings, *hidden.warnings), overlays=hidden.shown
    )


def within_circle(view: View, circle: Circle | None) -> View:
    """The view with the limit that a circle sets to its lens, and the pinhole camera of that."""
    if circle is None or view.lens is None:
        return view
    lens = within(view.lens, circle)
    if lens == view.lens:
        return view
    camera = pinhole(lens, view.camera.viewmat)
    return replace(view, lens=lens, camera=camera.scaled_to(view.camera.width, view.camera.height))


def hidden_in(photos: Sequence[Candidate], decode: Callable[[int, tuple[int, int]], Image.Image]) -> Hidden:
    """What never moves in the photos of one size and of one video or folder, and the circles that their pictures fill.

    Those with fewer than MIN_PHOTOS in their folder are compared with all of their size.

    decode: the photo with an index, at least so large where it is not smaller.
    """
    counts = Counter(((each.width, each.height), each.source) for each in photos)
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, each in enumerate(photos):
        size = each.width, each.height
        groups.setdefault(
            (size, each.source if counts[size, each.source] >= MIN_PHOTOS else None), []
        ).append(index)
    regions: list[Region | None] = [None] * len(photos)
    shown, warnings = [], []
    circles = _circles(photos, decode)
    for circle in dict.fromkeys(circle for circle in circles if circle is not None):
        members = [index for index, each in enumerate(circles) if each == circle]
        first, names = photos[members[0]], tuple(photos[index].name for index in members)
        outside = circle.outside(*training_size(first.width, first.height, FRAME_SIDE))
        what = f"{outside.mean():.0%} of the picture, round a circle, is dark {_which(photos, members)}"
        shown.append(Overlay(names, what, outside))
        warnings.append(
            f"{what}, such as {names[0]}. It is taken for the frame of what a lens shows, and is masked in all of "
            "them; the report shows it."
        )
        for index in members:
            regions[index] = outside
    for members in groups.values():
        names, which = tuple(photos[index].name for index in members), _which(photos, members)
        clear: list[Region] = []
        area = still(len(members), _pictures(photos, circles, members, decode, clear))
        # What is transparent in all of them, or lies round their circles, is known to be empty.
        if area is not None:
            area = area.without(np.logical_and.reduce(clear))
        if area is None:
            continue
        if not area.masked:
            warnings.append(
                f"{area.share:.0%} of the picture never changes {which}, such as {names[0]}. Either the camera stood "
                "still, as before a turntable, or it hardly moved. If something turned before it, mask all else."
            )
            continue
        what = f"{area.share:.0%} of the picture, {area.place}, never changes {which}"
        shown.append(Overlay(names, what, area.region))
        warnings.append(
            f"{what}, such as {names[0]}. It is taken for a logo, a text, a bar or a part of the camera's holder, and "
            "is masked in all of them; the report shows it. If it belongs to the scene, give photos from more sides."
        )
        for index in members:
            regions[index] = _together(regions[index], area.region)
    return Hidden(tuple(regions), tuple(circles), tuple(shown), tuple(warnings))


def _which(photos: Sequence[Candidate], members: Sequence[int]) -> str:
    first = photos[members[0]]
    return f"in {len(members)} photos of {first.width} x {first.height} pixels"


def _circles(
    photos: Sequence[Candidate], decode: Callable[[int, tuple[int, int]], Image.Image]
) -> tuple[Circle | None, ...]:
    """The circle that the picture of each photo fills, by the photos of one size and of one video or folder; those with
    fewer than FEWEST_OF_A_CIRCLE are taken with others of their size. None where there is none."""
    kinds = Counter((each.width, each.height, each.source) for each in photos)
    groups: dict[tuple[object, ...], list[int]] = {}
    for index, each in enumerate(photos):
        kind = each.width, each.height, each.source
        groups.setdefault(kind if kinds[kind] >= FEWEST_OF_A_CIRCLE else kind[:2], []).append(index)
    circles: list[Circle | None] = [None] * len(photos)
    for members in groups.values():
        if len(members) < FEWEST_OF_A_CIRCLE:
            continue
        clear: list[Region] = []
        picture = _pictures(photos, circles, members, decode, clear)
        # A ball that was cut out is round, too, and what is transparent around it is known.
        if not has_dark_corners(picture(0, 1)) or clear[0].any():
            continue
        chosen = np.unique(np.linspace(0, len(members) - 1, MOST_OF_A_CIRCLE).astype(int))
        circle = circle_in(np.max([picture(int(index), FINER) for index in chosen], axis=0))
        for index in members:
            circles[index] = circle
    return tuple(circles)


def _together(one: Region | None, other: Region) -> Region:
    """Two regions of one photo as one, at the higher resolution."""
    if one is None:
        return other
    enlarged = Image.fromarray(other).resize(one.shape[::-1], Image.Resampling.NEAREST)
    return np.asarray(one | np.asarray(enlarged))


def _pictures(
    photos: Sequence[Candidate],
    circles: Sequence[Circle | None],
    members: Sequence[int],
    decode: Callable[[int, tuple[int, int]], Image.Image],
    clear: list[Region],
) -> Callable[[int, int], npt.NDArray[np.float32]]:
    """The grey pictures of the photos `members`, as `still` asks for them.

    clear: gets what is transparent in each small one, or lies round its circle, [h,w].
    """
    first = photos[members[0]]

    def picture(index: int, factor: int) -> npt.NDArray[np.float32]:
        width, height = training_size(first.width, first.height, SMALL_SIDE)
        size = width * factor, height * factor
        photo = decode(members[index], size)
        if factor == 1:
            alpha = photo.getchannel("A") if photo.mode == "RGBA" else Image.new("L", size, 255)
            empty = np.asarray(alpha.resize(size, Image.Resampling.HAMMING)) < 128
            circle = circles[members[index]]
            clear.append(empty if circle is None else empty | circle.outside(*size))
        grey = Image.fromarray(small_grey(photo, SMALL_SIDE * factor))
        return np.asarray(grey.resize(size, Image.Resampling.HAMMING), np.float32)

    return picture


def mask_file(
    region: Region, own: Path | None, workdir: Path, *, upright: bool = True, shown_from: int = MIN_SHOWN
) -> Path:
    """A mask in `workdir` that hides the region, and what the photo's own mask hides; it shows from MIN_SHOWN on."""
    shown = Image.fromarray(np.where(region, 0, 255).astype(np.uint8))
    if own is not None:
        mine = shown_part(decoders.decode(own, upright=upright), shown_from)
        over = np.asarray(shown.resize(mine.size, Image.Resampling.NEAREST)) >= MIN_SHOWN
        shown = Image.fromarray(np.where(over, np.asarray(mine), 0).astype(np.uint8))
    digest = hashlib.sha256(shown.tobytes() + repr(shown.size).encode()).hexdigest()[:24]
    path = workdir / "overlays" / f"{digest}.png"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            shown.save(part, "PNG")
    return path
