"""The image and its gradient in 50 decimal digits: how exact the float64 reference is that errors are counted from.

Written from the formulas of docs/programming/numerics.md, apart from the kernels' code. For about twenty Gaussians and
a small image; gradients are central differences with a step of 1e-20, exact to some 30 digits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mpmath
import torch
from mpmath import mpf
from torch import Tensor

from .conditioning import Problem, state
from .scenes import GROUPS, SHORT, Scene, cloud, in_plane, rounded

DIGITS = 50
STEP = mpf(10) ** -20
mpmath.mp.dps = DIGITS

Numbers = list[Any]  # of mpf, nested as the array is


def small(ratio: float) -> Scene:
    """Twenty Gaussians in 12 x 12 pixels; needles of an axis ratio, or ordinary ones for 1."""
    scene = cloud(20, seed=5, width=12, height=12, focal=10.0)
    if ratio == 1:
        return scene
    log_scales = torch.full((20, 3), SHORT, dtype=torch.float64)
    log_scales[:, 0] = float(torch.log(torch.tensor(0.55 * ratio * 0.3)))
    angle = torch.rand(20, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 3
    return rounded(replace(scene, log_scales=log_scales, quats=in_plane(angle)))


def numbers(x: Tensor) -> Any:
    """The array as nested lists of mpf."""
    return mpf(x.item()) if x.dim() == 0 else [numbers(row) for row in x]


def project(g: dict[str, Any], scene: Scene) -> tuple[Any, ...] | None:
    """Centre, factored conic, opacity, colour and depth of one Gaussian."""
    V, K = numbers(scene.viewmat), numbers(scene.K)
    point = [sum(V[i][j] * g["means"][j] for j in range(3)) + V[i][3] for i in range(3)]
    z = point[2]
    fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
    u, v = point[0] / z, point[1] / z

    def held(t: Any, focal: Any, centre: Any, side: int) -> Any:
        low, high = -(mpf("0.15") * side + centre) / focal, (mpf("1.15") * side - centre) / focal
        return min(max(t, low), high)

    uh, vh = held(u, fx, cx, scene.width), held(v, fy, cy, scene.height)
    norm = mpmath.sqrt(sum(q * q for q in g["quats"]))
    w, x, y, zq = (q / norm for q in g["quats"])
    R = [
        [1 - 2 * (y * y + zq * zq), 2 * (x * y - w * zq), 2 * (x * zq + w * y)],
        [2 * (x * y + w * zq), 1 - 2 * (x * x + zq * zq), 2 * (y * zq - w * x)],
        [2 * (x * zq - w * y), 2 * (y * zq + w * x), 1 - 2 * (x * x + y * y)],
    ]
    S = [mpmath.exp(s) for s in g["log_scales"]]
    rows = [
        [fx / z * (V[0][j] - uh * V[2][j]) for j in range(3)],
        [fy / z * (V[1][j] - vh * V[2][j]) for j in range(3)],
    ]
    M = [[sum(row[i] * R[i][j] for i in range(3)) * S[j] for j in range(3)] for row in rows]
    a, c = (sum(m * m for m in M[k]) + mpf("0.3") for k in range(2))
    b = sum(M[0][j] * M[1][j] for j in range(3))
    det = a * c - b * b
    opacity = 1 / (1 + mpmath.exp(-g["logit_opacities"]))
    offset = [g["means"][j] + sum(V[i][j] * V[i][3] for i in range(3)) for j in range(3)]
    length = mpmath.sqrt(sum(o * o for o in offset))
    basis = harmonics(*(o / length for o in offset))
    color = [max(mpf(0), mpf("0.5") + sum(basis[k] * g["sh"][k][ch] for k in range(16))) for ch in range(3)]
    return fx * u + cx, fy * v + cy, c / det, -b / det, a / det, opacity, color, z


def harmonics(x: Any, y: Any, z: Any) -> Numbers:
    """The sixteen real spherical harmonics at a unit direction, in the order and with the signs of splat files."""
    pi, root = mpmath.pi, mpmath.sqrt
    k1, k4, k6 = root(3 / (4 * pi)), root(15 / (4 * pi)), root(5 / (16 * pi))
    k9, k11, k12 = root(35 / (32 * pi)), root(21 / (32 * pi)), root(7 / (16 * pi))
    k14, k10 = root(105 / (16 * pi)), root(105 / (4 * pi))
    return [
        root(1 / (4 * pi)), -k1 * y, k1 * z, -k1 * x,
        k4 * x * y, -k4 * y * z, k6 * (2 * z * z - x * x - y * y), -k4 * x * z, k4 / 2 * (x * x - y * y),
        -k9 * y * (3 * x * x - y * y), k10 * x * y * z, -k11 * y * (4 * z * z - x * x - y * y),
        k12 * z * (2 * z * z - 3 * x * x - 3 * y * y), -k11 * x * (4 * z * z - x * x - y * y),
        k14 * z * (x * x - y * y), -k9 * x * (x * x - 3 * y * y),
    ]  # fmt: skip


def image(splats: list[Any], width: int, height: int) -> Any:
    """Colours [H][W][3]."""
    ordered = sorted(splats, key=lambda s: s[7])
    cut, full, end = mpf(1) / 255, mpf(0.999), mpf(1e-4)
    pixels = []
    for py in range(height):
        for px in range(width):
            T, pixel = mpf(1), [mpf(0)] * 3
            for x, y, a, b, c, opacity, color, _ in ordered:
                dx, dy = px + mpf("0.5") - x, py + mpf("0.5") - y
                alpha = opacity * mpmath.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
                if alpha < cut:
                    continue
                alpha = min(alpha, full)
                if T * (1 - alpha) <= end:
                    break
                pixel = [p + T * alpha * k for p, k in zip(pixel, color, strict=True)]
                T *= 1 - alpha
            pixels.append(pixel)
    return [pixels[k * width : (k + 1) * width] for k in range(height)]


def compare(ratio: float, watched: int = 2) -> dict[str, float]:
    """Worst difference of the float64 reference from 50 digits, in units of conditioning at float32.

    Every pixel is compared, and every parameter of the first `watched` Gaussians but their SH beyond degree 0, which
    the gradients to the means contain.
    """
    problem: Problem = state(small(ratio), 8)
    scene = problem.scene
    groups = [{k: numbers(getattr(scene, k)[i]) for k in GROUPS} for i in range(20)]
    splats = [project(g, scene) for g in groups]
    weights = numbers(problem.weights)

    def total(changed: list[Any]) -> Any:
        pixels = image(changed, scene.width, scene.height)
        return sum(
            w * p
            for wr, pr in zip(weights, pixels, strict=True)
            for wp, pp in zip(wr, pr, strict=True)
            for w, p in zip(wp, pp, strict=True)
        )

    exact = image(splats, scene.width, scene.height)
    sure = ~problem.undecided
    off = torch.tensor(
        [[[float(p - mpf(problem.exact.image[y, x, c].item())) for c, p in enumerate(exact[y][x])]
          for x in range(scene.width)] for y in range(scene.height)], dtype=torch.float64,
    )  # fmt: skip
    worst = {"image": float((off.abs() / problem.unit.image)[sure].max())}
    for name in GROUPS:
        size = {"logit_opacities": 1, "sh": 3}.get(name, getattr(scene, name).shape[-1])
        ratios = []
        for i in range(watched):
            for slot in range(size):

                def at(step: Any, i: int = i, name: str = name, slot: int = slot) -> Any:
                    g = {k: (list(x) if isinstance(x, list) else x) for k, x in groups[i].items()}
                    if name == "logit_opacities":
                        g[name] = g[name] + step
                    elif name == "sh":
                        g[name] = [[x + step * (j == slot) for j, x in enumerate(g[name][0])], *g[name][1:]]
                    else:
                        g[name][slot] = g[name][slot] + step
                    return total([*splats[:i], project(g, scene), *splats[i + 1 :]])

                slope = (at(STEP) - at(-STEP)) / (2 * STEP)
                index = i if name == "logit_opacities" else (i, 0, slot) if name == "sh" else (i, slot)
                got = problem.exact.gradients[name][index]
                ratios.append(
                    abs(float(slope - mpf(got.item()))) / float(problem.unit.gradients[name][index])
                )
        worst[name] = max(ratios)
    return worst
