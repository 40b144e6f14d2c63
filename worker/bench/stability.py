# ruff: noqa: E501  (rows of Markdown tables are as long as they are)
"""`bench stability`: error against stiffness, one axis at a time, for every backend and for formulas that lose.

Each point is the worst of a few scenes that differ only in how extreme they are along one axis; the error is against the
float64 reference. A formula's own error (assembled determinant, transmittance recovered by division, ...) is measured in
float32 beside the one that the kernels use.
"""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import _plot
import numpy as np
import torch
from _rows import HERE, Row, build, footer, write
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.cpu import isa

SIDE = 48  # pixels of the square test image
GROUPS = ("means", "log_scales", "quats", "logit_opacities", "sh")


@dataclass
class Scene:
    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    sh: Tensor
    viewmat: Tensor
    K: Tensor

    def rounded(self) -> Scene:
        """The scene rounded to float32 and stored as float64: the input of every backend."""
        return Scene(*(x.float().double() for x in vars(self).values()))


def cloud(n: int = 60, seed: int = 0, depth: float = 3.0, focal: float = 40.0, spread: float = 0.9) -> Scene:
    """Gaussians of about 3 pixels around the middle of the view, camera at the origin; float64."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    unit = depth / focal  # one pixel, at that depth
    means = draw(n, 3) * torch.tensor([10.0 * unit, 10.0 * unit, 0.1 * depth * spread], dtype=torch.float64)
    means[:, 2] += depth
    sh = draw(n, 16, 3) * 0.1
    sh[:, 0] += 0.8
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    return Scene(
        means,
        math.log(3 * unit) + 0.3 * draw(n, 3),
        draw(n, 4),
        draw(n),
        sh,
        torch.eye(4, dtype=torch.float64),
        K,
    )


def needles(ratio: float, seed: int) -> Scene:
    """Gaussians whose projected axes differ by the factor `ratio`; the short one is the 0.3 pixel^2 filter alone."""
    scene = cloud(40, seed)
    long_axis = math.sqrt(0.3) * ratio * 3.0 / 40.0
    scene.log_scales = torch.full((40, 3), -30.0, dtype=torch.float64)
    scene.log_scales[:, 0] = math.log(long_axis)
    # Turned within the image plane, so that no needle points at the camera.
    angle = torch.rand(40, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * math.pi
    scene.quats = torch.stack([torch.cos(angle / 2), 0 * angle, 0 * angle, torch.sin(angle / 2)], 1)
    scene.logit_opacities = torch.full((40,), -1.5, dtype=torch.float64)
    return scene


def far_along(ratio: float, seed: int) -> Scene:
    return cloud(seed=seed, depth=0.0101 * ratio)


def pile(length: int, seed: int) -> Scene:
    """`length` Gaussians over the same pixels, each with an opacity of 0.006, just above the 1/255 cut."""
    scene = cloud(length, seed)
    scene.means[:, :2] *= 0.05
    scene.log_scales += math.log(4.0)
    scene.logit_opacities = torch.full((length,), math.log(0.006 / 0.994), dtype=torch.float64)
    return scene


def shifted(distance: float, seed: int) -> Scene:
    """The scene and its camera moved together by `distance`; the image changes by rounding alone."""
    scene = cloud(seed=seed)
    offset = torch.tensor([0.6, -0.5, 0.62], dtype=torch.float64) * distance
    scene.means = scene.means + offset
    scene.viewmat = scene.viewmat.clone()
    scene.viewmat[:3, 3] = -(scene.viewmat[:3, :3] @ offset)
    return scene


def with_logit(logit: float, seed: int) -> Scene:
    scene = cloud(8, seed)
    scene.logit_opacities = torch.full((8,), logit, dtype=torch.float64)
    return scene


def with_focal(relative: float, seed: int) -> Scene:
    """The same image with another focal length: the scene is moved away in proportion and 0.3 units deep."""
    focal = relative * SIDE
    scene = cloud(seed=seed, depth=max(0.075 * focal, 0.05), focal=focal, spread=0.0)
    scene.means[:, 2] += 0.01 * torch.randn(
        60, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    ).clamp(-1, 1)
    return scene


def with_norm(norm: float, seed: int) -> Scene:
    scene = cloud(seed=seed)
    scene.log_scales[:, 0] += 1.0
    scene.quats = scene.quats / scene.quats.norm(dim=1, keepdim=True) * norm
    return scene


@dataclass(frozen=True)
class Drawn:
    color: Tensor
    gradients: list[Tensor]


def draw(scene: Scene, backend: ops.Backend, dtype: torch.dtype) -> Drawn:
    """The image, and the gradients of a fixed weighted sum of its values."""
    leaves = [getattr(scene, k).to(dtype).requires_grad_() for k in GROUPS]
    means, log_scales, quats, logit_opacities, sh = leaves
    viewmat, K = scene.viewmat.to(dtype), scene.K.to(dtype)
    p = ops.project(
        means, log_scales, quats, logit_opacities, sh, viewmat, K, SIDE, SIDE, degree=3, backend=backend
    )
    color, _, _ = ops.composite(p, ops.bin(p, SIDE, SIDE, backend=backend), SIDE, SIDE, backend=backend)
    g = torch.Generator().manual_seed(1)
    weights = torch.rand(SIDE, SIDE, 3, generator=g).to(dtype) + 0.5
    gradients = torch.autograd.grad((color * weights).sum(), leaves)
    return Drawn(color.detach().double(), [x.double() for x in gradients])


def errors(got: Drawn, want: Drawn) -> dict[str, float]:
    """Mean absolute error of the image over its brightest value; error of the gradients, the worst group's, over its norm."""
    scale = float(want.color.abs().max()) or 1.0
    image = float((got.color - want.color).abs().mean()) / scale
    worst = 0.0
    for a, b in zip(got.gradients, want.gradients, strict=True):
        if float(b.norm()) > 0:
            worst = max(worst, float((a - b).norm() / b.norm()))
    return {"image": image, "gradient": worst if math.isfinite(worst) else 1e9}


def subjects() -> list[tuple[str, str | None, ops.Backend]]:
    """The subjects of the sweep: label in the figure, build of the CPU kernels, backend."""
    found: list[tuple[str, str | None, ops.Backend]] = [(f"cpu {b}", b, "cpu") for b in isa.supported()]
    found.append(("reference float32", None, "reference"))
    if torch.cuda.is_available():
        found.append(("gpu", None, "gpu"))
    return found


# ---- formulas, in float32, beside those that the kernels use. Each gives {name: (error, wins)} for one value of the axis.

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


def centres(distance: float) -> Formulas:
    """Error in pixels of a projected centre far from the origin, with and without recentring in float64 first."""
    got, want = (x.rounded() for x in (shifted(distance, 0), cloud()))
    W, t = got.viewmat[:3, :3].float(), got.viewmat[:3, 3].float()
    raw = got.means.float() @ W.T + t
    moved = shifted(distance, 0)
    centre = -moved.viewmat[:3, :3].T @ moved.viewmat[:3, 3]
    recentred = (moved.means - centre).float()

    def pixels(p: Tensor) -> Tensor:
        return p[:, :2] / p[:, 2:] * 40.0

    exact = pixels(want.means)
    return {
        "float32 world as it is (pixels)": (float((pixels(raw).double() - exact).abs().max()), False),
        "recentred in float64 (pixels)": (float((pixels(recentred).double() - exact).abs().max()), True),
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
class Axis:
    name: str
    label: str
    values: list[float]
    make: Callable[[float, int], Scene]
    formulas: Callable[[float], Formulas] | None
    log: bool = True
    formula_tolerance: float = 1e-4


def powers(low: int, high: int) -> list[float]:
    return [10.0**k for k in range(low, high + 1)]


AXES = [
    Axis("axis_ratio", "axis ratio of the projected ellipse", powers(0, 6), needles, determinants),
    Axis("depth", "depth / near plane", powers(0, 6), far_along, None),
    Axis(
        "list_length",
        "Gaussians on one pixel's list",
        [1, 10, 100, 1e3, 1e4, 1e5],
        lambda n, s: pile(int(n), s),
        transmittances,
    ),
    Axis(
        "distance",
        "distance of scene and camera from the origin",
        powers(0, 7),
        shifted,
        centres,
        formula_tolerance=0.01,
    ),
    Axis(
        "opacity",
        "logit of the opacity",
        [-5.4, -4, -2, 0, 2, 4, 6, 8, 10, 12, 14, 16],
        with_logit,
        sigmoid_slopes,
        log=False,
    ),
    Axis("focal", "focal length / image width", [0.05, 0.2, 1, 5, 25, 100, 1e3, 1e4], with_focal, None),
    Axis(
        "quaternion",
        "norm of the quaternion",
        [1e-30, 1e-24, 1e-18, 1e-12, 1e-6, 1, 1e6, 1e12, 1e18, 1e24, 1e30],
        with_norm,
        norms,
    ),
]
TOLERANCE = {
    "image": 1e-4,
    "gradient": 1e-3,
}  # a tenth of an 8-bit step on average; what training does not notice


DECISION = 3e-6
"""Relative distance from the 1/255 cut within which float32 may include a pixel that float64 skips: 25 roundings."""


def decided(scene: Scene, got: Drawn, error: float) -> dict[str, float]:
    """Errors of `got` against the closest reference whose 1/255 cut is moved by at most DECISION.

    A small value beside a large plain error means that a pixel lies on the cut, where the image and its
    gradient are discontinuous; no digits were lost.
    """
    definition: Any = importlib.import_module("splatmill_worker.kernels.reference.composite")
    cut, best = definition.ALPHA_MIN, {"gradient": error}
    try:
        for share in (-1.0, -0.33, -0.1, 0.1, 0.33, 1.0):
            definition.ALPHA_MIN = cut * (1 + share * DECISION)
            found = errors(got, draw(scene, "reference", torch.float64))
            best = min(best, found, key=lambda e: e["gradient"])
    finally:
        definition.ALPHA_MIN = cut
    return best


def sweep(axis: Axis, seeds: int) -> list[Row]:
    rows: list[Row] = []
    for value in axis.values:
        worst: dict[tuple[str, str], float] = {}
        for seed in range(seeds if value < 1e4 or axis.name != "list_length" else 1):
            scene = axis.make(value, seed).rounded()
            # Far from the origin rounding the inputs is the error, so the definition gets them unrounded there.
            exact = axis.make(value, seed) if axis.name == "distance" else scene
            want = draw(exact, "reference", torch.float64)
            for name, isa_name, backend in subjects():
                if isa_name is None:
                    got = draw(scene, backend, torch.float32)
                else:
                    with build(isa_name):
                        got = draw(scene, backend, torch.float32)
                for quantity, error in errors(got, want).items():
                    key = (name, quantity)
                    worst[key] = max(worst.get(key, 0.0), error)
                if axis.name == "list_length" and isa_name == isa.supported()[0]:
                    plain = errors(got, want)
                    nearest = plain
                    if plain["gradient"] > TOLERANCE["gradient"]:
                        nearest = decided(scene, got, plain["gradient"])
                    key = (f"{name}, the 1/255 cut within {DECISION:g}", "gradient")
                    worst[key] = max(worst.get(key, 0.0), nearest["gradient"])
        for (name, quantity), error in worst.items():
            rows.append(
                {
                    "bench": "stability", "axis": axis.name, "value": value, "subject": name, "quantity": quantity,
                    "error": error, "tolerance": TOLERANCE[quantity],
                }
            )  # fmt: skip
        for name, (error, wins) in axis.formulas(value).items() if axis.formulas else ():
            rows.append(
                {
                    "bench": "stability", "axis": axis.name, "value": value, "subject": name, "quantity": "formula",
                    "error": error, "tolerance": axis.formula_tolerance, "wins": wins,
                }
            )  # fmt: skip
    return rows


def figure(axis: Axis, rows: list[Row]) -> None:
    """Image, gradient and formula errors of one axis, side by side."""
    mine = [r for r in rows if r["axis"] == axis.name]
    quantities = [q for q in ("image", "gradient", "formula") if any(r["quantity"] == q for r in mine)]
    titles = {
        "image": "image: mean error / brightest",
        "gradient": "worst gradient group: error / norm",
        "formula": "formulas alone, float32",
    }
    drawn, panels = _plot.axes(len(quantities), width=4.6)
    for panel, quantity in zip(panels, quantities, strict=True):
        part = [r for r in mine if r["quantity"] == quantity]
        for i, subject in enumerate(dict.fromkeys(r["subject"] for r in part)):
            points = [(r["value"], max(r["error"], 1e-9)) for r in part if r["subject"] == subject]
            loses = quantity == "formula" and not next(r["wins"] for r in part if r["subject"] == subject)
            color = _plot.COLORS.get(subject, _plot.LOSER if loses else _plot.WINNER)
            panel.plot(
                *zip(*points, strict=True),
                "--" if loses else "-",
                marker="osv^D"[i % 5],
                markersize=6 - i,
                color=color,
                label=subject,
                lw=1.6,
            )
        tolerance = part[0]["tolerance"]
        panel.axhline(tolerance, color="#999999", lw=1, ls=":")
        panel.annotate(
            "tolerance",
            (1.0, tolerance),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=8,
            color="#777777",
        )
        panel.set_yscale("log")
        if axis.log:
            panel.set_xscale("log")
        panel.set_xlabel(axis.label)
        panel.set_title(titles[quantity], fontsize=10)
        panel.legend(fontsize=8)
    _plot.save(drawn, HERE / "figures" / f"stability_{axis.name}.png", footer(rows))


def leaves_tolerance(points: list[Row]) -> str:
    """A text that says from which value of the axis on the error exceeds the tolerance."""
    ordered = sorted(points, key=lambda r: r["value"])
    bad = [r["value"] for r in ordered if not r["error"] <= r["tolerance"]]
    if not bad:
        return "never"
    return ", ".join(f"{v:g}" for v in bad[:1]) + (
        " and on" if len(bad) > 1 and bad[-1] == ordered[-1]["value"] else ""
    )


def table(rows: list[Row]) -> str:
    lines = [
        "# Error against stiffness",
        "",
        "Generated by `python -m splatmill_worker bench stability` from `results/stability.jsonl`. Error of float32 against the float64",
        "reference, the least and the worst of each sweep; the last column says where along the axis it leaves its tolerance.",
        "The spike over the list length is a decision, not a loss of digits: at a thousand nearly transparent Gaussians one pixel stands on the 1/255 cut of",
        "one of them, and float32 takes it where float64 skips it; both image and gradient jump there. The row beside it takes as definition the one with the",
        f"cut moved by at most {DECISION:g} of itself that agrees best, and has no spike.",
        "",
        "| axis | what | quantity | mildest | worst | tolerance | leaves it at |",
        "|---|---|---|---|---|---|---|",
    ]
    for axis in AXES:
        mine = [r for r in rows if r["axis"] == axis.name]
        for subject, quantity in dict.fromkeys((r["subject"], r["quantity"]) for r in mine):
            points = [r for r in mine if (r["subject"], r["quantity"]) == (subject, quantity)]
            if subject in ("cpu avx2", "cpu baseline"):
                continue  # in the figures and rows; the same arithmetic as the best build
            lost = quantity == "formula" and not points[0]["wins"]
            name = f"*{subject}* (not used)" if lost else subject
            lines.append(
                f"| {axis.label} | {name} | {quantity} | {min(r['error'] for r in points):.1e} | "
                f"{max(r['error'] for r in points):.1e} | {points[0]['tolerance']:g} | {leaves_tolerance(points)} |"
            )
    lines += ["", *(f"![{a.label}](figures/stability_{a.name}.png)" for a in AXES), "", footer(rows), ""]
    return "\n".join(lines)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="bench stability", description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="scenes per point; the worst is kept")
    parser.add_argument(
        "--axis", choices=[a.name for a in AXES], action="append", help="only these (writes no files)"
    )
    options = parser.parse_args(argv)
    rows: list[Row] = []
    for axis in AXES:
        if options.axis and axis.name not in options.axis:
            continue
        rows += sweep(axis, options.seeds)
        for r in rows:
            if r["axis"] == axis.name and (options.axis or r["subject"].startswith(("cpu avx512", "gpu"))):
                print(
                    f"{axis.name:12} {r['value']:<10g} {r['subject']:40} {r['quantity']:9} {r['error']:.2e}"
                )
    if options.axis:
        return 0
    from _rows import read

    write("stability", rows)
    rows = read("stability")
    for axis in AXES:
        figure(axis, rows)
    (HERE / "stability.md").write_text(table(rows))
    return 0


if __name__ == "__main__":
    import sys

    sys.exit(main(sys.argv[1:]))
