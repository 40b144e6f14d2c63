"""Finds photos that are copies of others: resized, compressed again, brightened, turned, cropped or undistorted.

All of it works on small grey pictures (`SMALL_SIDE`). One of two is brought to the tones of the other, so that
exposure, gain and tone curves count for nothing, and is aligned with it by an affine map with a radial term. What a
copy shows agrees everywhere after that: a turntable's still background alone does not.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import PurePosixPath

import numpy as np
import numpy.typing as npt
from PIL import Image

from splatmill.schema.quantities import counted
from splatmill_worker.images.flow import sampled

SMALL_SIDE = 160
"""Longest side in pixels of the small pictures: a letter of an inserted text still has some pixels."""

GRID = 16
"""Sides of the pictures that are compared with all others, pixels."""

ALIKE = 0.95
"""Correlation of the ranks of their pixels from which two photos are aligned; few of a capture without copies reach
it."""

ALIKE_CROPPED = 0.4
"""The same for photos of two sizes, of which one may be a part of the other, and for those with one name."""

NEAREST = 3
"""Photos with which a photo is aligned, at most, for each quarter turn: time grows with the number of photos."""

SAME = 0.002
"""Mean displacement up to which two photos show the same, as a share of the longer side: a third of a small pixel, as
the grids of two sizes differ by that. A slow video moves by more from one kept frame to the next."""

ALIKE_ALIGNED = 0.9
"""Correlation of two aligned pictures below which their blocks are not compared."""

ALIKE_AT_PLACE = 0.8
"""The same where the cameras of both are at one place: the light may then fall off to the corners of one."""

CLIPPED = 5, 250
"""Grey levels outside which a photo may be clipped: a brightened copy shows less there."""

DETAILED = 20, 250
"""Grey levels outside which a photo shows little: those that are clipped, and those seven stops below white."""

MOST_CLIPPED = 0.9
"""Share of the pixels that may be clipped or outside of the other photo; of the rest, too little would be compared."""

MOST_CROPPED = 0.3
"""Largest share of a side that a cropped copy may lack."""

DIFFERS = 0.25
"""Share of the variance of a block that the other photo does not explain, from which it shows something else there."""

MOST_DIFFERING = 0.15
"""Share of the blocks that may differ where the cameras of both photos are at one place: compression leaves plain
blocks with little of the original."""

NOISE = 25.0
"""Variance in squared grey levels that compression alone produces."""

BLOCK = 20
"""Side of the blocks that are compared, in small pixels."""

LEVELS = (4, 2, 1)
"""Factors by which the small pictures are reduced, one after the other, to align them."""

ROUNDS = 8
"""Rounds of Gauss-Newton on each of these."""

EXACT = 4000
"""Norm to which these pictures are scaled before they are rounded. Sums of their products stay below 2^24, which
float32 adds without error, so that photos rank alike in whatever order a machine adds."""

ROWS = 256
"""Photos that are compared with all others at a time: all pairs of 10,000 would take 400 MB."""

Grey = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Kinds = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SmallPicture:
    """A photo at low resolution.

    name: of the photo.
    width, height: of the photo, pixels.
    grey: uint8 [h,w], its longest side at most SMALL_SIDE; transparent pixels are grey.
    original: whether its file has EXIF tags of a camera, which copies often lack.
    """

    name: str
    width: int
    height: int
    grey: Bytes
    original: bool = False

    @property
    def pixels(self) -> int:
        """Of the photo."""
        return self.width * self.height

    @cached_property
    def clipped(self) -> float:
        """The share of the pixels without detail (DETAILED), in steps of 5 %: compression changes less.

        Of an exposure series, the photo with the smallest share shows the most.
        """
        dark, bright = DETAILED
        return round(20.0 * float(((self.grey < dark) | (self.grey > bright)).mean())) / 20.0


def small_grey(image: Image.Image, side: int = SMALL_SIDE) -> Bytes:
    """The grey values of a decoded picture with a longest side of at most `side`; transparent pixels are grey."""
    factor = side / max(image.size)
    size = tuple(max(1, round(side * min(1.0, factor))) for side in image.size)
    small = image.resize((size[0], size[1]), Image.Resampling.HAMMING)
    if small.mode == "RGBA":
        behind = Image.new("RGBA", small.size, (128, 128, 128, 255))
        small = Image.alpha_composite(behind, small)
    return np.asarray(small.convert("L"))


def copies(
    pictures: Sequence[SmallPicture], on_compared: Callable[[int], None] = lambda done: None
) -> dict[int, int]:
    """The index of each photo that is a copy, and of the photo that is kept in its place.

    Kept is the photo with the most pixels; of those with as many, one with EXIF tags, then the one with the fewest
    clipped pixels, and then that with the shortest name. For 1,000 photos that are no copies this takes 0.5 to 5
    seconds of one core, by how many of them look alike.

    on_compared: called with the number of photos that were compared so far, after each.
    """
    ranked = sorted(
        range(len(pictures)),
        key=lambda i: (
            -pictures[i].pixels,
            not pictures[i].original,
            pictures[i].clipped,
            len(pictures[i].name),
            pictures[i].name,
        ),
    )
    kept: set[int] = set()
    originals: dict[int, int] = {}
    likely = _likely(pictures)
    for done, index in enumerate(ranked, 1):
        for other, turns in likely.get(index, ()):
            if other in kept and is_copy(pictures[index], pictures[other], turns):
                originals[index] = other
                break
        else:
            kept.add(index)
        on_compared(done)
    return originals


def warning(originals: Sequence[tuple[str, str]]) -> list[str]:
    """A sentence on the photos that are copies, given as pairs with the original; none where there are none."""
    if not originals:
        return []
    copy, original = originals[0]
    photos = counted(len(originals), "photo shows", "photos show")
    return [
        f"{photos} the same as another one and {'is' if len(originals) == 1 else 'are'} not used, such as {copy}, a "
        f"copy of {original}. The largest of each is used, and of several as large the one with the fewest clipped "
        "pixels; the others would train what held-out photos show."
    ]


def is_copy(picture: SmallPicture, kept: SmallPicture, turns: int = 0, *, one_place: bool = False) -> bool:
    """Whether `picture`, turned by so many quarter turns, shows what `kept` shows, or a part of it in fewer pixels.

    A photo whose lines were straightened is a copy too, where both have one name in two folders.

    one_place: whether the cameras of both are known to be at one place. A part of a photo is then a copy in any size,
        since nothing but a crop or a zoom enlarges what is seen from there.
    """
    turned = picture if not turns else _turned(picture, turns)
    first, second = _same_size(turned.grey, kept.grey)
    straightened = _same_stem(picture.name, kept.name)
    fewer = picture.pixels < kept.pixels and (picture.width, picture.height) != (kept.width, kept.height)
    # A crop changes the ranks of levels, and an exposure changes more than brightness and contrast.
    tones = (_same_tones(first, second), (first.astype(np.float32), second.astype(np.float32)))
    return any(_shows_same(*each, fewer, straightened, one_place) for each in tones)


def _shows_same(first: Grey, second: Grey, fewer: bool, straightened: bool, one_place: bool) -> bool:
    """Whether two pictures of one size show the same: `is_copy` for one reading of their tones.

    fewer: whether the first has fewer pixels. straightened: whether its lines may be straightened.
    """
    smaller = one_place or fewer
    alike, most = (ALIKE_AT_PLACE, MOST_DIFFERING) if one_place else (ALIKE_ALIGNED, 0.0)
    moved = _Motion.none()
    for factor in LEVELS:
        level = tuple(_reduced(each, factor) for each in (first, second))
        moved = _aligned(level[0], level[1], moved)
        # A pixel of the level more than SAME: coarse levels are exact to a small part of one.
        if not (straightened or smaller) and moved.length(first.shape) > SAME + 0.25 * factor / SMALL_SIDE:
            return False
        if not _correlation(level[0], *moved.sampled(level[1])) >= alike:
            return False
    if moved.length(first.shape) > SAME:
        inside = smaller and moved.is_part(first.shape)
        if not inside and not (straightened and moved.is_straightening(first.shape)):
            return False
    return _differing(first, *moved.sampled(second)) <= most


@dataclass(frozen=True)
class _Motion:
    """Where the pixels of one picture lie on another: x' = x + A (1, x, y, r^2 x), y' = y + B (1, x, y, r^2 y), in half
    the longer side from the middle. values: A and B without the last, which both share, and that, float64 [7].
    """

    values: npt.NDArray[np.float64]

    @staticmethod
    def none() -> _Motion:
        return _Motion(np.zeros(7))

    def flow(self, x: Grey, y: Grey) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """By how much positions move."""
        a, b, radial = self.values[:3], self.values[3:6], self.values[6] * (x * x + y * y)
        return a[0] + (a[1] + radial) * x + a[2] * y, b[0] + b[1] * x + (b[2] + radial) * y

    def length(self, shape: tuple[int, ...]) -> float:
        """The mean motion, as a share of the longer side."""
        return float(np.hypot(*self.flow(*_grid(shape))).mean() / 2.0)

    def is_part(self, shape: tuple[int, ...]) -> bool:
        """Whether the frame lies within that of the other picture, of which it lacks MOST_CROPPED at most."""
        x, y = _grid(shape)
        corners = (slice(None, None, shape[0] - 1), slice(None, None, shape[1] - 1))
        flow = self.flow(x[corners], y[corners])
        outward = np.stack([flow[0] * np.sign(x[corners]), flow[1] * np.sign(y[corners])])
        return bool(outward.max() <= 4.0 * SAME and outward.min() >= -2.0 * MOST_CROPPED)

    def is_straightening(self, shape: tuple[int, ...]) -> bool:
        """Whether the motion is symmetric around the middle and no larger than lenses bend lines."""
        x, y = _grid(shape)
        flow = np.stack(self.flow(x, y))
        middle = flow.mean(axis=(1, 2))
        return bool(np.abs(middle).max() <= 2.0 * SAME and np.abs(flow).max() <= MOST_CROPPED)

    def positions(
        self, shape: tuple[int, ...]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Rows and columns of the pixels of this picture on the other one, and which of these lie on it."""
        height, width = shape
        x, y = _grid(shape)
        right, down = self.flow(x, y)
        half = max(height, width) / 2.0
        column = (x + right) * half + width / 2.0 - 0.5
        row = (y + down) * half + height / 2.0 - 0.5
        return row, column, (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)

    def sampled(self, picture: Grey) -> tuple[Grey, npt.NDArray[np.bool_]]:
        """The other picture at the places of the pixels of this one, and which of these lie on it, unclipped."""
        row, column, inside = self.positions(picture.shape)
        values = sampled(picture, row, column)
        return values, inside & _unclipped(values)


def _likely(pictures: Sequence[SmallPicture]) -> dict[int, list[tuple[int, int]]]:
    """Photos that may show the same as each photo, the most similar first, each with the quarter turns in between."""
    if len(pictures) < 2:
        return {}
    grids = np.stack(
        [
            np.asarray(
                Image.fromarray(_ranks(each.grey)[each.grey]).resize((GRID, GRID), Image.Resampling.HAMMING)
            )
            for each in pictures
        ]
    )
    grids -= grids.mean(axis=(1, 2), keepdims=True)
    grids *= EXACT / (np.linalg.norm(grids, axis=(1, 2), keepdims=True) + 1e-6)
    sizes = _kinds([(each.width, each.height) for each in pictures])
    stems = _kinds([_stem(each.name) for each in pictures])
    return _nearest(np.rint(grids), sizes, stems)


def _nearest(grids: Grey, sizes: Kinds, stems: Kinds) -> dict[int, list[tuple[int, int]]]:
    """`_likely` for pictures of one size, of which photos of one size and those of one name have equal numbers.

    grids: whole numbers [n,GRID,GRID], each of mean 0 and norm EXACT, up to rounding.
    """
    count = len(grids)
    flat = grids.reshape(count, -1)
    # Most captures have photos of one size and no two of one name: then one limit holds for all pairs.
    mixed = len(np.unique(sizes)) > 1 or len(np.unique(stems)) < count
    partners: dict[int, list[tuple[float, int, int]]] = {}
    for turns in range(4):
        turned = np.rot90(grids, turns, axes=(1, 2)).reshape(flat.shape)
        for start in range(0, count, ROWS):
            rows = np.arange(start, min(start + ROWS, count))
            similar = (turned[rows] @ flat.T) / np.float32(EXACT**2)
            similar[np.arange(len(rows)), rows] = -1.0
            least = ALIKE
            if turns == 0 and mixed:
                least = ALIKE_CROPPED
                strict = (sizes[rows, None] == sizes) & (stems[rows, None] != stems)
                similar[strict & (similar < ALIKE)] = -1.0
            for _ in range(min(NEAREST, count - 1)):
                # Of equal ones, argmax returns the first.
                partner = similar.argmax(axis=1)
                best = similar[np.arange(len(rows)), partner]
                alike = np.flatnonzero(best >= least)
                if not len(alike):
                    break
                for at in alike:
                    partners.setdefault(int(rows[at]), []).append((-float(best[at]), int(partner[at]), turns))
                similar[np.arange(len(rows)), partner] = -1.0
    return {
        index: [(partner, turns) for _, partner, turns in sorted(each)] for index, each in partners.items()
    }


def _kinds(values: Sequence[Hashable]) -> Kinds:
    """A number for each value, equal for equal ones."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(value, len(numbers)) for value in values])


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _same_stem(first: str, second: str) -> bool:
    return _stem(first) == _stem(second) and PurePosixPath(first).parent != PurePosixPath(second).parent


def _turned(picture: SmallPicture, turns: int) -> SmallPicture:
    width, height = (picture.width, picture.height)[:: 1 if turns % 2 == 0 else -1]
    return replace(picture, width=width, height=height, grey=np.rot90(picture.grey, turns))


def _same_size(first: Bytes, second: Bytes) -> tuple[Bytes, Bytes]:
    """Both pictures at the size of the first, or of the second where that is smaller."""
    height, width = min(first.shape, second.shape)
    one, two = (
        np.asarray(
            Image.fromarray(np.ascontiguousarray(each)).resize((width, height), Image.Resampling.HAMMING)
        )
        for each in (first, second)
    )
    return one, two


def _same_tones(first: Bytes, second: Bytes) -> tuple[Grey, Grey]:
    """Both pictures, the one with fewer clipped pixels in the tones of the other: levels of one rank become equal."""
    if _unclipped(first).sum() < _unclipped(second).sum():
        return _same_tones(second, first)[::-1]
    ranks, present = _ranks(second), np.bincount(second.ravel(), minlength=256) > 0
    levels = np.interp(_ranks(first), ranks[present], np.flatnonzero(present)).astype(np.float32)
    return levels[first], second.astype(np.float32)


def _ranks(picture: Bytes) -> Grey:
    """The share of the pixels, 0 to 1, that are darker than each level 0 to 255, with half of those of that level."""
    counts = np.bincount(picture.ravel(), minlength=256)
    return ((np.cumsum(counts) - 0.5 * counts) / picture.size).astype(np.float32)


def _reduced(picture: Grey, factor: int) -> Grey:
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    if factor == 1 or min(height, width) < 8:
        return picture
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.HAMMING))


def _aligned(first: Grey, second: Grey, start: _Motion) -> _Motion:
    """The motion that brings `second` closest to `first` up to brightness and contrast, by Gauss-Newton.

    Baker and Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 2004.
    """
    x, y = (each.ravel() for each in _grid(first.shape))
    ones, squares = np.ones_like(x), x * x + y * y
    gradients = [np.asarray(each, np.float32) for each in np.gradient(second)]
    unclipped = _unclipped(first)
    half = max(first.shape) / 2.0
    motion = start
    for _ in range(ROUNDS):
        row, column, inside = motion.positions(second.shape)
        warped = sampled(second, row, column)
        counted = (inside & _unclipped(warped) & unclipped).ravel()
        down, right = (half * sampled(each, row, column).ravel() for each in gradients)
        columns = [
            *(right * each for each in (ones, x, y)),
            *(down * each for each in (ones, x, y)),
            squares * (right * x + down * y),
            -first.ravel(),
            -ones,
        ]
        jacobian = np.stack(columns, axis=1)[counted].astype(np.float64)
        if len(jacobian) < 4 * len(columns):
            return motion
        normal = jacobian.T @ jacobian
        # Plain pictures do not determine the motion: it then stays where it is.
        normal[np.diag_indices(7)] += len(jacobian) * np.array([1.0] * 6 + [10.0])
        step = np.linalg.solve(normal, -(jacobian.T @ warped.ravel()[counted]))[:7]
        motion = _Motion(np.clip(motion.values + step, -1.0, 1.0))
        if np.abs(step).max() * half < 0.01:
            break
    return motion


def _correlation(first: Grey, second: Grey, known: npt.NDArray[np.bool_]) -> float:
    """Of the pixels that can be compared; 0 where these are few or plain."""
    counted = known & _unclipped(first)
    if counted.mean() < 1.0 - MOST_CLIPPED:
        return 0.0
    (a, between), (_, b) = np.cov(first[counted], second[counted])
    return float(between / max(np.sqrt(a * b), 1e-9))


def _differing(first: Grey, second: Grey, known: npt.NDArray[np.bool_]) -> float:
    """The share of the blocks that show something else in the other picture, up to their brightness and contrast."""
    height, width = first.shape
    counted = known & _unclipped(first)
    compared = differing = 0
    for top in range(0, height, BLOCK):
        for left in range(0, width, BLOCK):
            block = slice(top, top + BLOCK), slice(left, left + BLOCK)
            some = counted[block]
            if some.sum() < BLOCK:
                continue
            (a, between), (_, b) = np.cov(first[block][some], second[block][some])
            least = min(a, b)
            unexplained = 1.0 - between * between / max(a * b, 1e-9)
            compared += 1
            differing += not unexplained * least <= DIFFERS * (least + NOISE)
    return differing / max(compared, 1)


def _unclipped(picture: Grey | Bytes) -> npt.NDArray[np.bool_]:
    return (picture >= CLIPPED[0]) & (picture <= CLIPPED[1])


@lru_cache(maxsize=16)
def _grid(shape: tuple[int, ...]) -> tuple[Grey, Grey]:
    """Positions x, y [H,W] of the pixels of a picture, in half the longer side from the middle."""
    height, width = shape
    half = max(height, width) / 2.0
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return (x + 0.5 - width / 2.0) / half, (y + 0.5 - height / 2.0) / half
