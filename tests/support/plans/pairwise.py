"""Pairwise covering arrays: few combinations in which every two levels of every two factors meet.

Cohen, Dalal, Fredman and Patton, "The AETG system: an approach to testing based on combinatorial design", 1997.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations, product

Level = tuple[str, str]
"""A factor and one of its levels."""

Pair = frozenset[Level]


def pairs(factors: Mapping[str, Sequence[str]]) -> set[Pair]:
    """Every two levels of every two factors."""
    return {
        frozenset(((one, level), (other, beside)))
        for one, other in combinations(factors, 2)
        for level, beside in product(factors[one], factors[other])
    }


def covering(factors: Mapping[str, Sequence[str]], excluded: Collection[Pair]) -> list[dict[str, str]]:
    """Combinations of a level of each factor, in which all `pairs` but the excluded ones occur, and none of these.

    Each is begun with a pair that none has yet, and takes the levels that add the most such pairs. Raises ValueError
    where a combination cannot be completed without an excluded pair.
    """
    missing = pairs(factors) - set(excluded)
    rows = []
    while missing:
        chosen = dict(min(missing, key=sorted))
        for factor in sorted(factors, key=lambda name: -len(factors[name])):
            if factor in chosen:
                continue
            allowed = [
                level
                for level in factors[factor]
                if not any(pair in excluded for pair in _with(chosen, factor, level))
            ]
            if not allowed:
                raise ValueError(f"No level of {factor} may stand beside {chosen}.")
            chosen[factor] = max(allowed, key=lambda level: len(missing & _with(chosen, factor, level)))
        missing -= {frozenset(pair) for pair in combinations(chosen.items(), 2)}
        rows.append(chosen)
    return rows


def _with(chosen: Mapping[str, str], factor: str, level: str) -> set[Pair]:
    return {frozenset((each, (factor, level))) for each in chosen.items()}
