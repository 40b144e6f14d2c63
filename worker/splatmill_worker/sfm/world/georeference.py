"""How the cameras' positions fit those that GPS gives: a similarity by consensus, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.scene import Float, Similarity

GPS_ERROR = 2.0
"""Error of GPS, in metres, that is assumed where the photos agree better: the errors of photos taken soon after each
other are alike, so that their agreement does not show them."""

BASELINE = 5.0
"""Distance that the photos must cover, as the root mean square from their mean, in errors of GPS. Scale and north are
then known to a fifth over the root of the number of photos."""

TILT = 10.0
"""The same across the direction of the largest spread, from which GPS determines down."""

AGREEING = 0.6
"""Share of the photos with GPS that must agree."""

FEWEST = 5
"""Photos that must agree."""

TRIALS = 500
"""Samples that are drawn. Of samples of 3 with 6 in 10 right, one in five is free of errors."""

CUT = 2.5
"""Errors, in standard deviations, up to which a photo agrees (Rousseeuw and Leroy 1987)."""


@dataclass(frozen=True)
class Fit:
    """A similarity from cameras' positions to GPS, in 2 or 3 dimensions.

    rotation: [d,d].
    scale: metres per unit of the cameras' positions.
    translation: [d], metres.
    agreeing: which photos agree, bool [n].
    error: standard deviation of a coordinate of those, in metres, and at least GPS_ERROR.
    spread: standard deviations of their positions along the principal directions [d], the largest first, in metres.
    """

    rotation: Float
    scale: float
    translation: Float
    agreeing: npt.NDArray[np.bool_]
    error: float
    spread: Float


def fit(centers: Float, measured: Float) -> Fit | str:
    """The similarity that takes most of `centers` [n,d] to `measured` [n,d], or why not, as the end of a sentence.

    By the least median of squares over random samples (Rousseeuw and Leroy 1987), and then by least squares over the
    positions that agree with it (Umeyama 1991).
    """
    count, dimensions = centers.shape
    if count < FEWEST:
        return f"{count} photos have a position by GPS, and {FEWEST} are needed"
    best, least = None, math.inf
    random = np.random.default_rng(0)
    for _ in range(TRIALS):
        sample = random.choice(count, dimensions, replace=False)
        guess = umeyama(centers[sample], measured[sample])
        if guess is None:
            continue
        median = float(np.median(_errors(guess, centers, measured)))
        if median < least:
            best, least = guess, median
    if best is None:
        return "the photos with GPS were taken at one place"
    # 1.4826 makes the median of one normal error its standard deviation; of a distance it is an upper bound.
    deviation = max(1.4826 * (1.0 + 5.0 / max(1, count - dimensions)) * least, 1e-9)
    for _ in range(5):
        agreeing = _errors(best, centers, measured) < CUT * max(deviation, GPS_ERROR)
        refined = umeyama(centers[agreeing], measured[agreeing]) if agreeing.sum() >= dimensions else None
        if refined is None:
            break
        best = refined
    agreeing = _errors(best, centers, measured) < CUT * max(deviation, GPS_ERROR)
    kept = int(agreeing.sum())
    if kept < max(FEWEST, AGREEING * count):
        return f"the GPS positions of only {kept} of {count} photos agree with their cameras"
    rotation, scale, translation = best
    residuals = _errors(best, centers[agreeing], measured[agreeing])
    error = max(GPS_ERROR, float(np.sqrt((residuals**2).mean() / dimensions)))
    around = scale * (centers[agreeing] - centers[agreeing].mean(axis=0))
    spread = np.linalg.svd(around, compute_uv=False) / math.sqrt(kept)
    covered = float(np.linalg.norm(spread))
    if not covered >= BASELINE * error:
        return (
            f"the photos were taken within {covered:.1f} m of their mean, and {BASELINE * error:.0f} m are needed for "
            f"a GPS error of {error:.1f} m"
        )
    return Fit(rotation, scale, translation, agreeing, error, spread)


def umeyama(source: Float, target: Float) -> tuple[Float, float, Float] | None:
    """Rotation [d,d], scale and translation [d] that take `source` [n,d] to `target` with the least squared error.

    None where the source is one point, or the best scale is zero (Umeyama 1991).
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.ones(len(s))
    signs[-1] = np.sign(np.linalg.det(u @ vt))
    rotation = u @ np.diag(signs) @ vt
    square = float((a**2).sum())
    scale = float((s * signs).sum()) / square if square > 0.0 else 0.0
    if not scale > 0.0 or not math.isfinite(scale):
        return None
    return rotation, scale, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


def down_by(gps_fit: Fit) -> Float | None:
    """Down [3] in the world of the cameras by a fit in 3 dimensions; None where the photos lie too near to a line."""
    if gps_fit.spread[1] < TILT * gps_fit.error:
        return None
    down: Float = -gps_fit.rotation[2]
    return down


def level_similarity(gps_fit: Fit, height: float) -> Similarity:
    """The similarity of a fit in x and z of an upright world (y down) to metres to the east and north.

    height: metres that are added to the world's upward coordinate to get the altitude over the origin.
    """
    rotation = np.eye(3)
    rotation[np.ix_([0, 2], [0, 2])] = gps_fit.rotation
    east, north = gps_fit.translation
    return Similarity(rotation, gps_fit.scale, np.array([east, -height, north]))


def _errors(similarity: tuple[Float, float, Float], centers: Float, measured: Float) -> Float:
    """Distances [n] of the moved centres to the measured positions."""
    rotation, scale, translation = similarity
    errors: Float = np.linalg.norm(scale * centers @ rotation.T + translation - measured, axis=1)
    return errors
