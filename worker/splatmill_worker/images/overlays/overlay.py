"""Finds what never moves in the photos of one camera: a logo, a watermark, a time code, a dashboard, black bars.

Where things of the scene pass a pixel, the curvature of the grey levels there differs from photo to photo, and its mean
is near zero. At an edge that is drawn over the photos it is the same in all of them, also where the overlay is half
transparent. The share that the mean explains is the coherence; Dekel et al., "On the effectiveness of visible
watermarks", CVPR 2017, find watermarks by such a mean of gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageFilter

MIN_PHOTOS = 12
"""Photos below which nothing is looked for: chance makes one pixel in exp(12 * COHERENT), or 400, coherent, and a
dozen of them side by side in none."""

MOST_PHOTOS = 64
"""Photos that are compared, evenly spaced: more make the answer no more certain."""

COHERENT = 0.5
"""Coherence from which an edge never moves. On photos of a scene hardly a pixel has as much."""

CERTAIN = 0.75
"""Coherence that a tenth of the edges of an overlay have at least. Round what turns on a level circle, a rim or the
horizon stays as well, but what lies on both sides of it differs from photo to photo."""

PARTLY = 0.3
"""Coherence down to which pixels beside such edges belong to them, as those of digits that change."""

EDGE = 3.0
"""Mean curvature of an edge, grey levels: that of a step of three levels, as of a faint watermark."""

NOISE = 4.0
"""Squared curvature, in squared grey levels, that compression alone produces."""

MIN_EDGE_PIXELS = 12
"""Coherent pixels of a small picture below which they are ignored: a letter has as many."""

MOVING = 0.3
"""Median coherence of the other edges from which the photos hardly differ, and nothing can be told apart."""

PARALLEL = 0.1
"""Squared curvature along one axis, over that along the other, below which edges are parallel to an axis."""

GAP = 3
"""Distance in small pixels, 2 % of the longer side, of edges that belong together, as the letters of a word."""

MARGIN = 2
"""Small pixels by which the region is enlarged: SIFT and the reduction of photos spread its edges."""

CALM = 0.6
"""Standard deviation of a region that edges cut off, over that of the scene, up to which it belongs to the overlay."""

CONSTANT = 3.0
"""Standard deviation in grey levels up to which a pixel is the same in all photos, but for their compression."""

OUTLINED = 0.75
"""Share of the outline of an opaque overlay that is an edge in half of the photos. A plain wall that the camera passes
has its outline elsewhere in each photo."""

MOST_OF_ONE = 0.25
"""Share of the photos up to which a constant part, with what lies beside it in its rectangle, is an overlay. The plain
background around a vase that turns ends as sharply, and surrounds it."""

MOST_HIDDEN = 0.5
"""Share of the photos from which the region is taken for a still background, and not masked."""

FINE = 4
"""Factor of the second look at a region: far things move by a pixel there that seem to stand still."""

FINE_PHOTOS = 16
"""Photos of that look."""

Grey = npt.NDArray[np.float32]
Region = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Still:
    """What never moves in photos of one camera.

    region: bool [h,w], at the size of the small pictures.
    share: of the photos that it covers.
    masked: whether it is small enough to be an overlay.
    """

    region: Region
    share: float
    masked: bool

    @property
    def place(self) -> str:
        """Where it lies, as a part of a sentence."""
        rows, columns = np.nonzero(self.region)
        height, width = self.region.shape
        names = []
        for low, high, size, first, last in (
            (rows.min(), rows.max(), height, "top", "bottom"),
            (columns.min(), columns.max(), width, "left", "right"),
        ):
            if high < 0.5 * size:
                names.append(first)
            elif low > 0.5 * size:
                names.append(last)
        return f"at the {' '.join(names)}" if names else "in several places"

    def without(self, part: Region) -> Still | None:
        """The same without a part of the picture and MARGIN around it; None where nothing is left."""
        region = self.region & ~_grown(part, MARGIN)
        return replace(self, region=region, share=float(region.mean())) if region.any() else None


def still(count: int, picture: Callable[[int, int], Grey]) -> Still | None:
    """What never moves in `count` pictures, all of one size; None where nothing is found.

    picture: [h,w] by its index, at so many times the size of the small pictures, or less where the photo is smaller.
    """
    if count < MIN_PHOTOS:
        return None
    chosen = np.unique(np.linspace(0, count - 1, MOST_PHOTOS).astype(int))
    stack = np.stack([picture(int(index), 1) for index in chosen])
    spread = stack.std(axis=0)
    region = _constant(stack, spread)
    coherence, strength, mean = _coherence(stack)
    edges = (coherence >= COHERENT) & (np.hypot(*mean) >= EDGE) & ~_grown(region, MARGIN)
    edges = _large(edges & ~_silhouettes(spread <= CONSTANT, region), MIN_EDGE_PIXELS)
    edges = _certain(_of_both_directions(edges, mean), coherence)
    if edges.any() and _rest_moves(coherence, strength, edges) and _holds(edges, chosen, picture):
        region |= _covered(edges, coherence, mean, spread)
    if not region.any():
        return None
    region = _grown(region, MARGIN)
    share = float(region.mean())
    return Still(region, share, share <= MOST_HIDDEN)


def _coherence(stack: Grey) -> tuple[Grey, Grey, Grey]:
    """Per pixel: the coherence, the mean squared curvature, and the mean curvature [2,h,w], of grey levels.

    Curvature is that along both axes. Gradients would be coherent in wide shades, too, while a camera hardly moves.
    """
    padded = np.pad(stack, ((0, 0), (1, 1), (1, 1)), mode="edge")
    down = padded[:, 2:, 1:-1] - 2.0 * stack + padded[:, :-2, 1:-1]
    right = padded[:, 1:-1, 2:] - 2.0 * stack + padded[:, 1:-1, :-2]
    strength = (down**2 + right**2).mean(axis=0)
    mean = np.stack([down.mean(axis=0), right.mean(axis=0)])
    return (mean**2).sum(axis=0) / (strength + NOISE), strength, mean


def _rest_moves(coherence: Grey, strength: Grey, edges: Region) -> bool:
    """Whether the edges of the rest of the picture are elsewhere in each photo."""
    rest = (strength > 4.0 * NOISE) & ~_grown(edges, GAP + MARGIN)
    return bool(rest.any() and np.median(coherence[rest]) < MOVING)


def _holds(edges: Region, chosen: npt.NDArray[np.int64], picture: Callable[[int, int], Grey]) -> bool:
    """Whether half of the edges are coherent in a finer look as well."""
    some = chosen[np.unique(np.linspace(0, len(chosen) - 1, FINE_PHOTOS).astype(int))]
    fine = _coherence(np.stack([picture(int(index), FINE) for index in some]))[0]
    height, width = edges.shape
    # The largest value of each small pixel.
    rows = np.minimum(np.arange(fine.shape[0]) * height // fine.shape[0], height - 1)
    columns = np.minimum(np.arange(fine.shape[1]) * width // fine.shape[1], width - 1)
    largest = np.zeros(edges.shape, np.float32)
    np.maximum.at(largest, (rows[:, None], columns[None, :]), fine)
    return bool(np.median(largest[edges]) >= COHERENT)


def _covered(edges: Region, coherence: Grey, mean: Grey, spread: Grey) -> Region:
    """What the edges cover: them, partly coherent pixels beside them, what lies between, and what they cut off."""
    partly = (coherence >= PARTLY) & (np.hypot(*mean) >= EDGE)
    covered = edges
    while True:
        more = covered | (partly & _grown(covered, GAP))
        if (more == covered).all():
            break
        covered = more
    covered = ~_grown(~_grown(covered, GAP), GAP)
    parts = _parts(~covered)
    scene = max(parts, key=np.count_nonzero, default=~covered)
    typical = float(np.median(spread[scene])) if scene.any() else 0.0
    for part in parts:
        if part is not scene and np.median(spread[part]) <= CALM * typical:
            covered = covered | part
    return covered


def _constant(stack: Grey, spread: Grey) -> Region:
    """Opaque overlays, found by what is the same in all photos and ends at an edge: bars along a side, and parts."""
    constant = spread <= CONSTANT
    region = np.zeros_like(constant)
    for turns in range(4):
        rows, hidden = np.rot90(constant, turns), np.rot90(region, turns)
        whole = np.asarray(rows.all(axis=1))
        count = len(whole) if whole.all() else int(np.argmin(whole))
        bar = np.zeros_like(rows)
        bar[:count] = True
        if 0 < count < len(whole) and _is_outlined(np.rot90(bar, -turns), stack):
            hidden[:count] = True
    for part in _parts(_large(constant & ~region, MIN_EDGE_PIXELS)):
        rectangle = np.prod(np.ptp(np.argwhere(part), axis=0) + 1)
        large = np.count_nonzero(part) >= MIN_EDGE_PIXELS and rectangle <= MOST_OF_ONE * part.size
        if large and _is_outlined(part, stack):
            region |= part
    return region


def _silhouettes(constant: Region, bars: Region) -> Region:
    """Where things that turn before a plain background end: beside a large constant part, and not constant."""
    background = np.zeros_like(constant)
    for part in _parts(constant & ~bars):
        if np.count_nonzero(part) > MOST_OF_ONE * part.size:
            background |= part
    return _grown(background, GAP) & ~constant


def _is_outlined(part: Region, stack: Grey) -> bool:
    """Whether most pixels around a part differ from its own by an edge, in half of the photos."""
    around = _grown(part, 1) & ~part
    near = _grown(around, 1) & part
    levels = np.where(near, stack, np.nan)
    rows, columns = np.nonzero(around)
    jumps = []
    for row, column in zip(rows, columns, strict=True):
        window = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        beside = np.nanmean(levels[(slice(None), *window)], axis=(1, 2))
        jumps.append(np.median(np.abs(stack[:, row, column] - beside)))
    return bool(np.mean(np.array(jumps) >= 2.0 * EDGE) >= OUTLINED) if jumps else False


def _large(region: Region, least: int) -> Region:
    """The region without groups of pixels, at most GAP apart, that have fewer than `least` pixels."""
    kept = np.zeros_like(region)
    if np.count_nonzero(region) >= least:
        for part in _parts(_grown(region, GAP)):
            if np.count_nonzero(part & region) >= least:
                kept |= part & region
    return kept


def _of_both_directions(edges: Region, mean: Grey) -> Region:
    """The groups of edges that are not all parallel: a straight edge stays where a camera moves along it."""
    kept = np.zeros_like(edges)
    for part in _parts(_grown(edges, GAP)):
        own = part & edges
        along = (mean[:, own] ** 2).sum(axis=1)
        if along.min() >= PARALLEL * along.max():
            kept |= own
    return kept


def _certain(edges: Region, coherence: Grey) -> Region:
    """The groups of edges of which a tenth is certain not to move."""
    kept = np.zeros_like(edges)
    for part in _parts(_grown(edges, GAP)):
        own = part & edges
        if np.quantile(coherence[own], 0.9) >= CERTAIN:
            kept |= own
    return kept


def _grown(region: Region, radius: int) -> Region:
    """The region and all pixels at most `radius` from it, along both axes."""
    image = Image.fromarray(region.astype(np.uint8) * 255)
    return np.asarray(image.filter(ImageFilter.MaxFilter(2 * radius + 1))) > 0


def _parts(region: Region) -> list[Region]:
    """The connected parts of a region: each pixel takes the largest number among its neighbours until none changes."""
    numbers = np.where(region, np.arange(1, region.size + 1).reshape(region.shape), 0)
    while True:
        padded = np.pad(numbers, 1)
        near = [padded[1:-1, 1:-1], padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
        larger = np.where(region, np.max(near, axis=0), 0)
        if (larger == numbers).all():
            return [numbers == number for number in np.unique(numbers[region])]
        numbers = larger
