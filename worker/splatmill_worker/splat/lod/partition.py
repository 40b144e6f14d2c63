"""The tree of a scene: halves of halves of its Gaussians, down to leaves whose levels are chosen by themselves."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LEAF = 8192
"""Gaussians of a leaf at most."""


@dataclass(frozen=True)
class Node:
    """A part of the scene.

    first, last: its leaves are those from `first` to before `last`, in the order of the tree.
    children: its two halves; None for a leaf.
    """

    first: int
    last: int
    children: tuple[Node, Node] | None = None


def partition(means: Tensor, leaf: int = LEAF) -> tuple[Node, list[Tensor]]:
    """Return the tree over `means` [N, 3], and the rows of each leaf, int64, in the order of the tree.

    A node of more than `leaf` rows is halved at the median along the longest side of its box. So the tree of N rows has
    a depth of log2(N / leaf), and making it takes O(N log(N) log(N / leaf)).
    """
    leaves: list[Tensor] = []

    def split(rows: Tensor) -> Node:
        first = len(leaves)
        if len(rows) <= leaf:
            leaves.append(rows.sort().values)
            return Node(first, first + 1)
        low, high = torch.aminmax(means[rows], dim=0)
        ordered = rows[torch.argsort(means[rows, int((high - low).argmax())], stable=True)]
        half = len(rows) // 2
        children = split(ordered[:half]), split(ordered[half:])
        return Node(first, len(leaves), children)

    return split(torch.arange(len(means))), leaves
