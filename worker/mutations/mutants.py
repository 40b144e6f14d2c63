# ruff: noqa: E501  (pieces of source are as long as they are)
"""The faults that the kernels' proofs have to catch: each replaces one piece of source, once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

KERNELS = Path("splatmill_worker/kernels")


@dataclass(frozen=True)
class Mutant:
    """`before` occurs in the file exactly once."""

    name: str
    file: str  # below kernels/
    before: str
    after: str


def cpu(name: str, file: str, before: str, after: str) -> Mutant:
    return Mutant(name, f"cpu/{file}", before, after)


def reference(name: str, file: str, before: str, after: str) -> Mutant:
    return Mutant(name, f"reference/{file}", before, after)


MUTANTS = [
    # ---- blending, forward
    cpu("alpha is not held at 0.999", "composite_forward.cpp", "min(exp2_of_alpha(e), kAlphaMax)", "exp2_of_alpha(e)"),
    cpu("no cut at 1/255", "composite_forward.cpp", "const Mask hit = e >= kLog2AlphaMin;",
        "const Mask hit = e >= kLog2AlphaMin - 1.0f;"),
    cpu("a pixel does not end at 1e-4", "composite_forward.cpp", "hit & (T_after > kTransmittanceMin)",
        "hit & (T_after > 0.0f)"),
    cpu("the background is not weighted by T", "composite_forward.cpp", "fma(T, background[c], load(planes[c]))",
        "load(planes[c]) + background[c]"),
    cpu("green twice", "composite_forward.cpp", "store(block.blue, fma(w, blue, load(block.blue)));",
        "store(block.blue, fma(w, green, load(block.blue)));"),
    cpu("depth weighted by alpha", "composite_forward.cpp", "store(block.depth, fma(w, splat(r.depth)",
        "store(block.depth, fma(alpha, splat(r.depth)"),
    cpu("pixel centres off by 1/100", "composite_forward.cpp", "x0 = tile_x * kTile + 0.5f, y0 = tile_y * kTile + 0.5f",
        "x0 = tile_x * kTile + 0.51f, y0 = tile_y * kTile + 0.5f"),
    # ---- blending, backward
    cpu("what lies behind keeps the splat itself", "composite_backward.cpp",
        "const Float behind = load(block.behind) - gain;", "const Float behind = load(block.behind);"),
    cpu("the sign of what lies behind", "composite_backward.cpp", "behind, gain);  // alpha dL/dalpha",
        "-behind, gain);  // alpha dL/dalpha"),
    cpu("no division by 1 - alpha", "composite_backward.cpp", "keep_product(blended, alpha, reciprocal(1.0f - alpha))",
        "keep_product(blended, alpha, splat(1.0f))"),
    cpu("no gate at 0.999", "composite_backward.cpp", "q = keep(raw <= splat(kAlphaMax), q);", "(void)raw;"),
    cpu("the u v sum is half", "composite_backward.cpp", "s[kSumQUV] = fma(qu, v, s[kSumQUV]);",
        "s[kSumQUV] = fma(qu * 0.5f, v, s[kSumQUV]);"),
    cpu("alpha's gradient left out", "composite_backward.cpp", "behind = fnma(d_alpha, final_T, behind);", "(void)d_alpha;"),
    cpu("depth's gradient left out", "composite_backward.cpp", "along = fma(splat(r.depth), load(block.d_depth), along);", ";"),
    cpu("the last pair of a tile is dropped", "composite_backward.cpp", "for (; k < walked; ++k) {",
        "for (; k + 1 < walked; ++k) {"),
    # ---- sums of pairs
    cpu("the last pair of a Gaussian is dropped", "step.cpp", "k < span.first + span.count; ++k)",
        "k + 1 < span.first + span.count || k == span.first; ++k)"),
    cpu("the opacity's slope is o", "step.cpp", "d.logit = s[kSumQ] * o.complement;", "d.logit = s[kSumQ];"),
    cpu("the 2-D mean's y lacks the shear", "step.cpp", "d.y2d = fma(f.uy, s[kSumQU], f.vy * s[kSumQV]) * k1;",
        "d.y2d = f.vy * s[kSumQV] * k1;"),
    cpu("the covariance's gradient is 1 % large", "step.cpp", "k2 = 2.0f * kLn2 * kLn2", "k2 = 2.02f * kLn2 * kLn2"),
    # ---- projection
    cpu("a sign of one harmonic", "harmonics.hpp", "basis[13] = d.x * -k11", "basis[13] = d.x * k11"),
    cpu("a colour that is not finite is drawn", "project.cpp", "o.visible &= is_finite(color[c]);", ";"),
    # ---- lists
    cpu("the sort leaves out a bit", "bin.cpp", "const int bits = range ? 32 - __builtin_clz(range) : 0;",
        "const int bits = range ? 31 - __builtin_clz(range) : 0;"),
    # ---- pose, Adam, loss, neighbours
    cpu("a variance of SSIM may be negative", "loss.cpp", "const Float variance1 = max(fnma(mu1, mu1, square.out[o]), 0.0f);",
        "const Float variance1 = fnma(mu1, mu1, square.out[o]) - 1e-4f;"),
    cpu("SSIM's slope by the mean lacks a term", "loss.cpp", "fnma(2.0f * mu1, by_square, fnma(mu2, by_product, direct))",
        "fnma(mu2, by_product, direct)"),
    cpu("a tap of the window", "loss.cpp", "0.0360007721f", "0.0350007721f"),
    # ---- the definition itself
    reference("half the off-diagonal of the conic", "project.py", "conics = torch.stack([c / det, -b / det, a / det], 1)",
              "conics = torch.stack([c / det, -0.5 * b / det, a / det], 1)"),
    reference("the opacity's compensation is differentiated", "project.py", "(sharp / det).detach()", "(sharp / det)"),
    reference("the direction from the origin", "project.py", "direction = means + W.T @ t", "direction = means + 0 * t"),
    reference("alpha passes its gradient where it is clamped", "composite.py",
              "torch.where(alphas <= ALPHA_MAX, alphas, ALPHA_MAX)", "alphas - (alphas - ALPHA_MAX).clamp_min(0).detach()"),
    reference("transmittance includes the splat itself", "composite.py",
              "torch.cat([torch.ones_like(alphas[:, :1]), 1 - alphas[:, :-1]], 1)", "1 - alphas"),
    reference("equal depths in any order", "bin.py", "torch.argsort(projected.depths[visible], stable=True)",
              "torch.argsort(projected.depths[visible].flip(0)).flip(0).sub(len(visible) - 1).neg()"),
    reference("a sign of one harmonic", "harmonics.py",
              "-0.4570457994644658 * x * (4 * zz", "0.4570457994644658 * x * (4 * zz"),
    cpu("the motion's rotation has the wrong sign", "pose.hpp", "A(j, k) - A(k, j)", "A(k, j) - A(j, k)"),
]  # fmt: skip

NEXT = [
    cpu("2^x loses a digit", "math.hpp", "p = fma(p, f, 6.931217909e-01f);", "p = fma(p, f, 6.931317909e-01f);"),
    cpu("the opacity's slope cancels", "geometry.hpp", "o.complement = odds_against * o.sigmoid;",
        "o.complement = 1.0f - o.sigmoid;"),
    cpu("no bound on x/z in the Jacobian", "geometry.hpp", "o.u_held = min(max(o.u, cam.low_u), cam.high_u);",
        "o.u_held = o.u;"),
    cpu("gradient through the bound on x/z", "geometry.hpp", "keep(o.u_free, held_u)", "held_u"),
    cpu("half the off-diagonal", "geometry.hpp", "o.b = fma(o.M0[n], o.M1[n], o.b);",
        "o.b = fma(o.M0[n] * 0.5f, o.M1[n], o.b);"),
    cpu("the determinant from the assembled conic", "geometry.hpp",
        "o.det = fma(kBlur, trace0 + trace1, sharp) + kBlur * kBlur;", "o.det = o.a * o.c - o.b * o.b;"),
    cpu("the first row of F M by the cancelling formula", "geometry.hpp",
        "ux_c * fma(kBlur, o.M0[n], o.M1[n1] * minor[n2] - o.M1[n2] * minor[n1])", "f.ux * o.M0[n] + f.uy * o.M1[n]"),
    cpu("a transposed entry of R", "geometry.hpp", "o.R[1][2] = fnma(w, ii, jj * k);", "o.R[1][2] = fma(w, ii, jj * k);"),
    cpu("an index of R's gradient", "geometry.hpp", "s12 = dR[1][2] + dR[2][1];", "s12 = dR[1][2] + dR[1][2];"),
    cpu("the quaternion's gradient keeps its radial part", "geometry.hpp", "fnma(along, o.quat[n], dq[n]) * o.quat_inv",
        "dq[n] * o.quat_inv"),
    cpu("the quaternion is squared unscaled", "geometry.hpp", "q[i] = q[i] / largest;", "largest = splat(1.0f);"),
    cpu("1/z forgets the scales", "geometry.hpp", "fma(du, o.u, fma(dv, o.v, with_scale))", "fma(du, o.u, dv * o.v)"),
    cpu("the direction's gradient keeps its radial part", "geometry.hpp", "fnma(radial, dir.x, dd.x) * inv_distance",
        "dd.x * inv_distance"),
    cpu("no gate at colour 0", "geometry.hpp", "keep(color[c] >= 0.0f, d.color[c])", "d.color[c]"),
    cpu("a factor in one harmonic's slope", "harmonics.hpp", "y * z * e[11] * (8 * k11)", "y * z * e[11] * (4 * k11)"),
    cpu("no gradient to the camera's third row by x/z", "geometry.hpp", "fx_z * o.u_held * dT0[n] + fy_z * o.v_held",
        "fy_z * o.v_held"),
    cpu("antialiasing without its root", "geometry.hpp", "sqrt(max(sharp / o.det, kCompensationMin))",
        "max(sharp / o.det, kCompensationMin)"),
    cpu("the extent is 3 sigma", "geometry.hpp", "max(o.cut * (2.0f * kLn2), 0.0f)", "splat(4.0f) + 0.0f * o.cut"),
    cpu("the scale's NaN is not looked for", "geometry.hpp", "o.visible &= not_finite == 0.0f;", ";"),
    cpu("z = near is drawn", "geometry.hpp", "(o.z > cam.near)", "(o.z >= cam.near)"),
    cpu("the reach of an ellipse has no corner", "reach.hpp", "static constexpr float kSpan = kBlockSide - 1;",
        "static constexpr float kSpan = kBlockSide - 2;"),
    cpu("a column of tiles is missing", "reach.hpp", "bounded((r.x + r.extent_x - 0.5f) * kPerTile + 1.0f, columns)",
        "bounded((r.x + r.extent_x - 0.5f) * kPerTile, columns)"),
    cpu("the bias correction of the second moment", "adam.hpp", "1.0 / std::sqrt(1.0 - std::pow(kBeta2",
        "1.0 / (1.0 - std::pow(kBeta2"),
    cpu("the second moment from the first", "adam.hpp", "squared * static_cast<float>(1.0 - kBeta2)",
        "squared * static_cast<float>(1.0 - kBeta1)"),
    cpu("a NaN gradient is taken", "adam.hpp", "m = select(good, m1, m);", "m = m1;"),
    cpu("the search ends at the nearest neighbour", "knn.cpp", "return squared[kNeighbors - 1];", "return squared[0];"),
]  # fmt: skip
"""Faults that the proofs have not been run on yet, or do not catch: `run.py --next`. A caught one moves up.

"2^x loses a digit" survives: it only triples the error of 2^x, and the proofs allow 20 units.
"""
