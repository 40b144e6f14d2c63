"""Reconstructions in which two sides of a scene were taken for one, mapped again.

A can with its label on both sides matches itself from the other side. When more pairs of photos show both sides as one
than show how the camera went from one to the other, a mapper believes them: it folds the sides onto each other, and the
camera leaps back between two photos that were taken one after the other. These are the witnesses: two photos far apart
in time that match may show things that look alike, but a camera does not leap between two photos that overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm import features
from splatmill_worker.sfm.agreement import Poses, agreement
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.matching.pairs import Pair
from splatmill_worker.sfm.matching.two_view import MIN_INLIERS
from splatmill_worker.sfm.run import UNFOLDED, EffortResult, SfmRun
from splatmill_worker.sfm.trials import best_mapping, registered_counts

WITNESS_INLIERS = 2 * MIN_INLIERS
"""Inliers of two photos taken one after the other from which their match is believed."""

WITNESS_REACH = 2
"""Distance, in positions of the order of shooting, up to which photos were taken one after the other."""

CHAIN_REACHES = (2, 4, 8)
"""Such distances up to which photos make the chain: the first one that connects enough of them. With few photos a wider
reach takes in the other side."""

EXPLAINED = 0.5
"""Share of a pair's inliers that fit the cameras from which the cameras explain the pair."""

CONTRADICTED = 0.25
"""Share below which they contradict it. By chance a tenth to a sixth fits (decisions: unfold)."""

MAX_TURN = 30.0
"""Degrees by which a pair may turn otherwise than in the chain, which drifts: half of the smallest turn that brings a
thing with six alike sides onto itself."""

MAX_SHIFT = 0.25
"""Distance by which a pair may lie otherwise than in the chain, as a share of the way between its photos."""

KEPT_REGISTERED = 0.9
"""Share of the reliably registered photos of the folded model that the new one must register reliably, too."""


@dataclass(frozen=True)
class _Candidate:
    """A mapping without the pairs `left_out`, the witnesses that it contradicts, and COLMAP's database of it."""

    mapped: mapper.Mapped
    left_out: frozenset[Pair]
    contradicted: frozenset[Pair]
    database: Path


def unfold(run: SfmRun, result: EffortResult) -> None:
    """Map the photos again where the camera leaps between two that were taken one after the other and match.

    First they are mapped from such photos alone: this chain drifts, but goes where the camera went. Of the other pairs
    those are kept which the chain explains, or which the model explains and places where the chain does; the rest show
    things that look alike. The photos are mapped once more from what is kept.

    `result.mapped` and `result.left_out` are changed where that leaves fewer contradictions and enough photos; a note
    says what was found either way. Raises Cancelled.
    """
    # Panoramas and fisheyes show the surroundings, which differ where a thing looks alike from two sides.
    if (
        result.mapped is None
        or result.mapped.largest is None
        or any(group.is_panorama or group.is_fisheye for group in run.groups)
    ):
        return
    database = pycolmap.Database.open(result.database)
    try:
        _Unfolding(run, result, result.mapped.largest, database).run()
    finally:
        database.close()


class _Unfolding:
    """One call of `unfold`, for the model `folded`."""

    def __init__(
        self,
        run: SfmRun,
        result: EffortResult,
        folded: pycolmap.Reconstruction,
        database: pycolmap.Database,
    ) -> None:
        self._run, self._result, self._database = run, result, database
        self._folded = Poses(folded)
        self._orders = _orders(run)
        self._verified = frozenset(result.verified)
        self._witnesses = [
            pair
            for pair in _within(self._orders, WITNESS_REACH) & self._verified
            if result.matched[pair].inliers >= WITNESS_INLIERS
        ]

    def run(self) -> None:
        against = self._contradicted_by(self._folded)
        if not against:
            return
        enough = KEPT_REGISTERED * registered_counts(self._result.mapped)[0]
        for reach in CHAIN_REACHES:
            neighbours = _within(self._orders, reach)
            chain = self._mapped_without(self._verified - neighbours, "chain.db")
            links = [Poses(model) for model in chain.mapped.models]
            if self._in_one_piece(links) >= enough:
                break
        pieces = [_Placement(self._folded, poses, self._orders) for poses in links]
        leaps = [
            pair
            for pair in against
            if any(piece.holds(pair) and piece.is_elsewhere(pair, 1.0) for piece in pieces)
        ]
        alike = frozenset(pair for pair in self._verified - neighbours if not self._keeps(pieces, pair))
        tried = [chain]
        if leaps and alike:
            tried.insert(0, self._mapped_without(alike, "without-alike.db"))
            kept = [each for each in tried if registered_counts(each.mapped)[0] >= enough]
            best = min(kept, key=lambda each: len(each.contradicted), default=None)
            if best is not None and len(best.contradicted) < len(against):
                best.database.replace(self._result.database.with_name(UNFOLDED))
                self._result.mapped, self._result.left_out = best.mapped, best.left_out
            self._note(min(leaps), len(self._result.left_out or alike), bool(self._result.left_out))
        for each in tried:
            each.database.unlink(missing_ok=True)

    def _in_one_piece(self, links: list[Poses]) -> int:
        """Number of photos in the largest piece of each order."""
        return sum(
            max((len(poses.photos.intersection(order)) for poses in links), default=0)
            for order in self._orders
        )

    def _keeps(self, pieces: list[_Placement], pair: Pair) -> bool:
        """Whether the chain speaks for a pair, or the folded model does and the chain says nothing."""
        explained = self._folded.have(pair) and self._share(self._folded, pair) >= EXPLAINED
        holding = [piece for piece in pieces if piece.holds(pair)]
        if not holding:
            return explained
        return any(
            (explained and not piece.is_elsewhere(pair, MAX_SHIFT))
            or self._share(piece.chain, pair) >= EXPLAINED
            for piece in holding
        )

    def _share(self, poses: Poses, pair: Pair) -> float:
        return agreement(poses, self._result, self._database, pair)

    def _contradicted_by(self, poses: Poses) -> frozenset[Pair]:
        """The witnesses that a model contradicts."""
        return frozenset(
            pair for pair in self._witnesses if poses.have(pair) and self._share(poses, pair) < CONTRADICTED
        )

    def _mapped_without(self, left_out: frozenset[Pair], name: str) -> _Candidate:
        """The photos mapped without some pairs, from a database of this name."""
        result = self._result
        numbers = [(result.ids[first], result.ids[second]) for first, second in left_out]
        path = result.database.with_name(name)
        features.copy_without_pairs(result.database, path, numbers)
        mapped = best_mapping(self._run, path, self._verified - left_out)
        largest = mapped.largest
        contradicted = (
            self._contradicted_by(Poses(largest)) if largest is not None else frozenset(self._witnesses)
        )
        return _Candidate(mapped, left_out, contradicted, path)

    def _note(self, leap: Pair, alike: int, better: bool) -> None:
        first, second = (self._run.prepared.photos[photo].name for photo in leap)
        finding = (
            f"Sides of the scene look alike: {alike} pairs of photos match because of it, and the cameras that they "
            f"led to leap between photos that were taken one after the other (first {first} and {second})."
        )
        outcome = (
            "The photos were mapped again without these pairs."
            if better
            else "Mapping without these pairs gave no better cameras: the sides may lie on each other in the model. "
            "Take more photos on the way from one side to the other, with more of the surroundings in them."
        )
        self._run.notes.append(f"{finding} {outcome}")


class _Placement:
    """Where the folded model and a model of the chain place pairs of photos."""

    def __init__(self, folded: Poses, chain: Poses, orders: list[list[int]]) -> None:
        self.folded, self.chain = folded, chain
        self._way: dict[int, float] = {}
        ratios = []
        for order in orders:
            gone = 0.0
            held = [photo for photo in order if self.holds((photo, photo))]
            for last, photo in zip([None, *held], held, strict=False):
                if last is not None:
                    step = _length(chain, (last, photo))
                    gone += step
                    ratios.append(step / max(_length(folded, (last, photo)), 1e-12))
                self._way[photo] = gone
        # Most steps are right in both models, whose units differ.
        self._scale = float(np.median(ratios)) if ratios else 1.0

    def holds(self, pair: Pair) -> bool:
        """Whether both models have both photos."""
        return self.folded.have(pair) and self.chain.have(pair)

    def is_elsewhere(self, pair: Pair, max_shift: float) -> bool:
        """Whether the models differ by more than MAX_TURN, or by more than the share `max_shift` of the way."""
        rotation, translation = self.folded.between(pair)
        turned, moved = self.chain.between(pair)
        cosine = (np.trace(turned @ rotation.T) - 1.0) / 2.0
        turn = math.degrees(math.acos(float(np.clip(cosine, -1.0, 1.0))))
        shift = float(np.linalg.norm(moved - self._scale * translation))
        return turn > MAX_TURN or shift > max_shift * abs(self._way[pair[1]] - self._way[pair[0]])


def _orders(run: SfmRun) -> list[list[int]]:
    """The photos in the orders in which they were taken, as far as these are known."""
    if run.options.matcher == "sequential":
        return [list(range(run.count))]
    photos = run.prepared.photos
    return [*pairs.video_sequences(photos), *pairs.numbered_runs(photos)]


def _within(orders: list[list[int]], reach: int) -> frozenset[Pair]:
    """Pairs of photos at most `reach` positions apart in one of the orders."""
    return frozenset(pair for order in orders for pair in pairs.sequential(order, range(1, reach + 1)))


def _length(poses: Poses, pair: Pair) -> float:
    """The distance between the places of two photos."""
    return float(np.linalg.norm(poses.between(pair)[1]))
