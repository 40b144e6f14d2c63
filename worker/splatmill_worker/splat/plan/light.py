"""How the light of each photo departs from that of the photos around it, from points that several photos see."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatmill_worker.splat.plan.observations import Observations
from splatmill_worker.splat.views import TrainingView

Float = npt.NDArray[np.float64]

DARKEST, BRIGHTEST = 8, 247
"""Grey levels of 255 between which a value measures the light: darker ones are mostly noise, brighter ones clipped."""

RESIDUAL_FLOOR = 0.02
"""Natural logarithm of brightness: residuals below this floor have the same weight."""

ITERATIONS = 30
"""Iterations of the reweighted least squares that separates exposures from the brightness of points."""

ENOUGH_OF_A_PHOTO = 10
"""Number of observations of a photo from which its exposure counts."""

ENOUGH_PHOTOS = 3
"""Number of such photos from which exposures are compared."""

REACHES = (0.25, 0.5, 1.0, 2.0)
"""Distances between cameras over which light is smooth, in radii of the cameras around their mean; turns count by the
chord between the directions. The one that predicts best is taken."""

SHARES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Variances of what is not smooth, over the variance of what is. The one that predicts best is taken."""

SMOOTH_REACH = 0.5
"""The shortest of REACHES that predicts best where light is smooth (decisions: LIGHT_UNSEEN)."""

SMOOTH_NOISE = 0.01
"""Share, as in SHARES, that goes with it."""

TOGETHER = 500
"""Photos that predict one another, at most: the time for n grows as n³. More are divided by where they were taken
(decisions: TOGETHER)."""

CLEAR = 2.0
"""Standard errors by which the prediction has to be better than a constant: one of many may be so by chance."""

TAIL = 0.9
"""Share of the photos that depart less than the fact `light_tail` says."""


@dataclass(frozen=True)
class Light:
    """Exposure and white balance of n photos, as natural logarithms of factors on red, green and blue.

    exposures: [n, 3]; their mean over photos is zero. Zero for a photo that shows too few points.
    departures: the part of them [n, 3] that the photos around do not predict; its mean is zero too.
    errors: standard error of an exposure [n], from the spread of the photo's points; infinite without an exposure.
    unseen: share of the variance of light that is smooth over SMOOTH_REACH which the photos around would leave
        unpredicted: 0 where photos are close to one another, 1 where none predicts another.
    """

    exposures: Float
    departures: Float
    errors: Float
    unseen: float

    @property
    def spread(self) -> float:
        """Robust standard deviation of the exposures."""
        return _spread(self.exposures[self._known].mean(axis=1))

    @property
    def tint_spread(self) -> float:
        """The same of red over green or of blue over green, whichever spreads more."""
        red, green, blue = self.exposures[self._known].T
        return max(_spread(red - green), _spread(blue - green))

    @property
    def tail(self) -> float:
        """Largest departure of any colour that TAIL of the photos stay below."""
        return float(np.quantile(np.abs(self.departures[self._known]).max(axis=1), TAIL))

    @property
    def error(self) -> float:
        """Median standard error of the exposures."""
        return float(np.median(self.errors[self._known]))

    @property
    def _known(self) -> npt.NDArray[np.bool_]:
        known: npt.NDArray[np.bool_] = np.isfinite(self.errors)
        return known


def compared(observations: Observations, views: Sequence[TrainingView]) -> Light | None:
    """The light of the photos `views` from their observations; None where too few photos have enough of them.

    The logarithm of each value is modelled as the sum of a term of its point and a term of its photo. Adding a constant
    to all photos and taking it from all points changes no value: that is the gauge of the model. It is fixed by a mean
    of zero over photos, each photo counting once, since a mean by visits or points would let the photos of what many
    photos show decide for the others.

    A trained scene has more freedom than this model: its colours depend on the direction of view. Light that changes
    smoothly with the camera is then as much a property of the scene as of the photos, and held-out photos, taken
    between the others, share it. These smooth changes are a gauge freedom too, to the extent that the photos around
    predict them. So they are taken out of the exposures, and `departures` has what is left: the error of predicting
    each photo from all others by a Gaussian process over the cameras' positions and directions with a free constant,
    whose reach and noise are those of the least mean error (Rasmussen and Williams 2006, section 5.4.2). The constant
    alone predicts where that is not clearly worse. Of more than TOGETHER photos, those taken near one another predict
    one another, with a constant of their own.
    """
    exposures, errors = _exposures(observations)
    known = np.isfinite(errors)
    if known.sum() < ENOUGH_PHOTOS:
        return None
    cameras = [view.full.camera for view, finite in zip(views, known, strict=True) if finite]
    places = np.array([camera.center for camera in cameras])
    places -= places.mean(axis=0)
    places /= max(float(np.linalg.norm(places, axis=1).max()), 1e-12)
    directions = np.array([camera.viewmat[2, :3] for camera in cameras])
    parts = [
        (rows, _squared_distances(places[rows]) + _squared_distances(directions[rows]))
        for rows in divided(places)
    ]
    departures = np.zeros_like(exposures)
    departures[known] = _unpredicted(exposures[known], parts)
    return Light(exposures, departures, errors, _unseen(parts))


def divided(points: Float) -> list[npt.NDArray[np.int64]]:
    """Rows of points [n, 3] in parts of at most TOGETHER near ones: halved along the axis of the widest spread."""
    parts, left = list[npt.NDArray[np.int64]](), [np.arange(len(points))]
    while left:
        rows = left.pop()
        if len(rows) <= TOGETHER:
            parts.append(rows)
            continue
        axis = int(np.argmax(points[rows].std(axis=0)))
        order = rows[np.argsort(points[rows, axis], kind="stable")]
        left += [order[len(order) // 2 :], order[: len(order) // 2]]
    return parts


def _exposures(observations: Observations) -> tuple[Float, Float]:
    """Exposures [n, 3] and their standard errors [n] by reweighted least squares, solved in alternation.

    Weights fall with the residual, so that outliers (highlights, occlusions) have little influence.
    """
    exposures = np.zeros((observations.photos, 3))
    errors = np.zeros(observations.photos)
    for channel in range(3):
        values = observations.color[:, channel].astype(np.float64)
        told = ((values >= DARKEST) & (values <= BRIGHTEST)).astype(np.float64)
        log = np.log(np.maximum(values, 1.0))
        of_photo, residual, weight = np.zeros(observations.photos), log, told
        enough = np.bincount(observations.photo, told, minlength=observations.photos) >= ENOUGH_OF_A_PHOTO
        for _ in range(ITERATIONS):
            of_point = _group_mean(
                log - of_photo[observations.photo], weight, observations.point, observations.points
            )
            of_photo = _group_mean(
                log - of_point[observations.point], weight, observations.photo, observations.photos
            )
            of_photo = np.where(enough, of_photo - of_photo[enough].mean() if enough.any() else 0.0, 0.0)
            residual = log - of_point[observations.point] - of_photo[observations.photo]
            weight = told / np.maximum(np.abs(residual), RESIDUAL_FLOOR)
        exposures[:, channel] = of_photo
        # The mean absolute deviation of a normal distribution is 0.8 of its standard deviation.
        deviation = _group_mean(np.abs(residual), told, observations.photo, observations.photos) / 0.8
        count = np.bincount(observations.photo, told, minlength=observations.photos)
        errors = np.maximum(errors, np.where(enough, deviation / np.sqrt(np.maximum(count, 1.0)), np.inf))
    exposures[~np.isfinite(errors)] = 0.0
    return exposures, errors


_Part = tuple[npt.NDArray[np.int64], Float]
"""Photos that predict one another: their rows [n], and the squared distances of their cameras [n, n]."""


def _unpredicted(exposures: Float, parts: Sequence[_Part]) -> Float:
    """What the exposures [n, 3] differ by from those that a smooth function of the other photos' cameras predicts."""

    def fit(kernel: Callable[[Float], Float], share: float) -> tuple[Float, Float]:
        """The absolute errors in brightness [n], and all errors [n, 3]."""
        rest = np.zeros_like(exposures)
        for rows, apart in parts:
            inverse = _precision(kernel(apart), share)
            # Times the values: the error of each from all others.
            rest[rows] = inverse / np.diag(inverse)[:, None] @ exposures[rows]
        return np.abs(rest.mean(axis=1)), rest

    plain, by_constant = fit(np.zeros_like, 1.0)
    fits = [(plain, by_constant)]
    fits += [fit(_smooth_over(reach), share) for reach in REACHES for share in SHARES]
    least, rest = min(fits, key=lambda each: float(each[0].mean()))
    gain = plain - least
    if not gain.mean() > CLEAR * gain.std() / np.sqrt(len(exposures)):
        rest = by_constant
    centred: Float = rest - rest.mean(axis=0)
    return centred


def _unseen(parts: Sequence[_Part]) -> float:
    """`Light.unseen` of the photos."""
    # What is left of a value that all others predict has one over the diagonal as its variance, noise included.
    left = [
        1.0 / np.diag(_precision(_smooth_over(SMOOTH_REACH)(apart), SMOOTH_NOISE)) - SMOOTH_NOISE
        for _, apart in parts
    ]
    return float(np.clip(np.median(np.concatenate(left)), 0.0, 1.0))


def _smooth_over(reach: float) -> Callable[[Float], Float]:
    """The covariance of what is smooth over `reach`, by squared distances."""
    return lambda apart: np.exp(-0.5 * apart / reach**2)


def _precision(kernel: Float, noise: float) -> Float:
    """Inverse covariance [n, n] of a Gaussian process with `kernel`, a free mean, and noise."""
    wide = 1e3  # variance of the mean: so large that it is free
    covariance: Float = kernel + wide + noise * np.eye(len(kernel))
    return np.asarray(np.linalg.inv(covariance), np.float64)


def _squared_distances(points: Float) -> Float:
    squared: Float = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return squared


def _spread(values: Float) -> float:
    # 1.4826 times the median absolute deviation is the standard deviation of a normal distribution.
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _group_mean(values: Float, weights: Float, group: npt.NDArray[np.int64], groups: int) -> Float:
    """Weighted mean of `values` per group; 0 where a group is empty."""
    total = np.bincount(group, weights, minlength=groups)
    mean: Float = np.bincount(group, weights * values, minlength=groups) / np.maximum(total, 1e-12)
    return mean
