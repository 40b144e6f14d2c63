"""Formulas in float32 beside those that the kernels use instead. Each gives {name: (error, used)} for a value."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Formulas = dict[str, tuple[float, bool]]


def determinants(ratio: float) -> Formulas:
    """Relative error of det(M M^T + 0.3 I) for random needles, and the share that a cull on det > 0 would remove."""
    g = np.random.default_rng(0)
    n = 2000
    angle, long_axis = g.uniform(0, np.pi, n), math.sqrt(0.3) * ratio
    m0 = np.stack([np.cos(angle) * long_axis, 1e-3 * g.normal(size=n), 1e-3 * g.normal(size=n)], 1)
    m1 = np.stack([np.sin(angle) * long_axis, 1e-3 * g.normal(size=n), 1e-3 * g.normal(size=n)], 1)
    m0, m1 = m0.astype(np.float32), m1.astype(np.float32)

    def exact(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        minors = np.cross(x, y)
        value: np.ndarray = (minors**2).sum(1) + 0.3 * ((x**2).sum(1) + (y**2).sum(1)) + 0.09
        return value

    want = exact(m0.astype(np.float64), m1.astype(np.float64))
    blur = np.float32(0.3)
    a, b, c = (m0 * m0).sum(1) + blur, (m0 * m1).sum(1), (m1 * m1).sum(1) + blur
    assembled = a * c - b * b
    minors = np.cross(m0, m1)
    factor = (minors * minors).sum(1) + blur * ((m0 * m0).sum(1) + (m1 * m1).sum(1)) + np.float32(0.09)
    return {
        "assembled a c - b^2": (float(np.median(np.abs(assembled - want) / want)), False),
        "Cauchy-Binet on the factor": (float(np.median(np.abs(factor - want) / want)), True),
    }


def transmittances(length: float) -> Formulas:
    """Error of the weights along a list, relative to the largest: T carried forward, or recovered from 1 - alpha."""
    n = int(length)
    g = np.random.default_rng(1)
    alpha = g.uniform(1 / 255, 0.02, n).astype(np.float32)
    if n > 4:
        alpha[:: max(n // 4, 1)] = np.float32(0.9)
    exact = np.cumprod(1 - alpha.astype(np.float64))
    last = int(np.searchsorted(-exact, -1e-4))  # the stop
    alpha = alpha[: max(last, 1)]
    before = np.concatenate([[1.0], np.cumprod(1 - alpha.astype(np.float64))])
    want = before[:-1] * alpha
    one = np.float32(1)
    forward, t = np.empty_like(alpha), one
    for i, x in enumerate(alpha):
        forward[i], t = t * x, t * (one - x)
    backward, total = np.empty_like(alpha), np.float32(0)
    for w in forward:
        total += w
    t = one - total  # what an image that stores alpha still knows of T
    for i in range(len(alpha) - 1, -1, -1):
        t = t / (one - alpha[i])
        backward[i] = t * alpha[i]
    scale = np.maximum(want, 1e-30)
    return {
        "recovered by division, back to front": (float(np.max(np.abs(backward - want) / scale)), False),
        "carried front to back": (float(np.max(np.abs(forward - want) / scale)), True),
    }


def sigmoid_slopes(logit: float) -> Formulas:
    """Relative error of d sigmoid / d logit = o (1 - o)."""
    x = np.float32(logit)
    o = np.float32(1) / (np.float32(1) + np.exp(-x))
    want = math.exp(-float(x)) / (1 + math.exp(-float(x))) ** 2 if logit > -700 else 0.0
    direct = o * (np.float32(1) - o)
    other = o * (np.exp(-x) / (np.float32(1) + np.exp(-x)))
    return {
        "o (1 - o)": (abs(float(direct) - want) / want, False),
        "o e^-x / (1 + e^-x)": (abs(float(other) - want) / want, True),
    }


def norms(norm: float) -> Formulas:
    """Error of normalising a quaternion of any norm."""
    q = (np.array([0.5, -0.7, 0.3, 0.4]) / np.sqrt(0.99) * norm).astype(np.float32)
    want = q.astype(np.float64) / np.linalg.norm(q.astype(np.float64))
    with np.errstate(all="ignore"):
        plain = q / np.sqrt((q * q).sum(dtype=np.float32) + np.float32(1e-30))
    scaled = q / np.abs(q).max()
    scaled = scaled / np.sqrt((scaled * scaled).sum(dtype=np.float32))

    def off(x: np.ndarray) -> float:
        return float(np.nan_to_num(np.abs(x - want), nan=1.0).max())

    return {"q / sqrt(q.q + 1e-30)": (off(plain), False), "largest component first": (off(scaled), True)}


@dataclass(frozen=True)
class FormulaAxis:
    name: str
    label: str
    values: list[float]
    errors: Callable[[float], Formulas]
    log: bool = True


FORMULAS = [
    FormulaAxis("determinant", "axis ratio", [10.0**k for k in range(7)], determinants),
    FormulaAxis("transmittance", "length of the list", [10.0**k for k in range(6)], transmittances),
    FormulaAxis("opacity slope", "logit", [-5.4, -2, 2, 6, 10, 12, 14, 16], sigmoid_slopes, log=False),
    FormulaAxis("quaternion", "norm of the quaternion", [10.0**k for k in range(-30, 31, 6)], norms),
]
