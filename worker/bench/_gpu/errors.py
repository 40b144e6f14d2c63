"""Errors of the fused step on the device: proofs on small scenes, and needles in units of their conditioning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from _rows import Row
from torch import Tensor

from .scene import View, cloud
from .timing import Place

GROUPS = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh": 48}


def gradients(step: Any, degree: int) -> dict[str, Tensor]:
    """The gradients of the last update at an SH degree, float64 on the host, [N, channels] by group."""
    planes = step._gradient.t().cpu().double()
    planes[:, 11 + 3 * (degree + 1) ** 2 :] = 0.0  # coefficients that the degree leaves out are not written
    return dict(zip(GROUPS, torch.split(planes, list(GROUPS.values()), dim=1), strict=True))


def definition(
    view: View, dtype: torch.dtype, degree: int, antialias: bool, mask: Tensor | None
) -> tuple[float, dict[str, Tensor]]:
    """The loss of the view's photo and its gradients by the reference's ops, on the host."""
    from splatmill_worker.kernels import ops, reference

    leaves = [x.to(dtype).requires_grad_() for x in view.groups]
    means, log_scales, quats, logits, sh = leaves
    fields = ops.project(
        means, log_scales, quats, logits, sh, view.viewmat.to(dtype), view.K.to(dtype), view.width, view.height,
        degree=degree, antialias=antialias, backend="reference",
    )  # fmt: skip
    bins = reference.bin(fields, view.width, view.height)
    color, _, _ = reference.composite(fields, bins, view.width, view.height)
    loss = reference.loss(color, view.photo, mask=mask)
    loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    slopes = [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]
    named = zip(GROUPS.items(), slopes, strict=True)
    return float(loss.detach()), {name: g.double().reshape(-1, width) for (name, width), g in named}


def prove(place: Place) -> Iterator[Row]:
    """A training step on small scenes: loss and gradients against float64, beside what float32 itself is off by.

    A row passes where every gradient is as near to float64 as eight times the reference's own float32, or 64 roundings
    of the group's largest value; where two visits give one loss to 1e-5; and where, on a device, torch sees no
    synchronisation in the second visit.
    """
    from splatmill_worker.kernels.gpu.step import Step
    from splatmill_worker.kernels.records import Rates

    still = Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    n, width, height = (6, 12, 8) if place.dry else (400, 128, 96)
    for seed, (degree, antialias, masked) in enumerate(
        [(1, True, True), (3, False, False)][: 1 if place.dry else 2]
    ):
        view = cloud(n, width, height, seed)
        g = torch.Generator().manual_seed(seed)
        mask = torch.rand(height, width, generator=g) < 0.8 if masked else None
        exact, truth = definition(view, torch.float64, degree, antialias, mask)
        _, plain = definition(view, torch.float32, degree, antialias, mask)
        step = Step(*view.groups, where=place.device)
        more: dict[str, Any] = {"degree": degree, "antialias": antialias, "mask": mask, "rates": still}
        step.train(view.viewmat, view.K, view.photo, step=1, **more)
        waits = ""
        if not place.dry:
            torch.cuda.synchronize()
            torch.cuda.set_sync_debug_mode("error")
        try:
            step.train(view.viewmat, view.K, view.photo, step=2, **more)
        except RuntimeError as error:
            waits = str(error).splitlines()[0]
        finally:
            if not place.dry:
                torch.cuda.set_sync_debug_mode("default")
        loss = step.train(view.viewmat, view.K, view.photo, step=3, **more).loss
        shares = {}
        for name, gradient in gradients(step, degree).items():
            true = truth[name]
            spread = float((plain[name] - true).abs().max())
            allowed = 8 * spread + 64 * 2.0**-24 * float(true.abs().max())
            shares[name] = float((gradient - true).abs().max()) / max(allowed, 1e-300)
        passed = max(shares.values()) <= 1 and abs(loss - exact) <= 1e-5 and not waits
        yield {
            "gaussians": n, "degree": degree, "antialias": antialias, "masked": masked, "passed": passed,
            "loss_error": loss - exact, "share_of_allowed": shares, "waits": waits,
        }  # fmt: skip


def needles(place: Place) -> Iterator[Row]:
    """Image and gradients of needles: largest and median error, in units of what half an ulp of the inputs does.

    1 is what no algorithm that reads rounded inputs can be asked to go below; see `bench stability` for the unit.
    """
    from _studies.stability.conditioning import state
    from _studies.stability.scenes import cloud as few
    from _studies.stability.scenes import needles as on_the_image
    from _studies.stability.scenes import needles_beside

    from splatmill_worker.kernels.gpu.step import Step

    for where, make in (("on the image", on_the_image), ("beside it", needles_beside)):
        for ratio in (1e2,) if place.dry else (1e1, 1e2, 1e3, 1e4):
            # In the interpreter a few round Gaussians, since a needle's image has too many tiles.
            scene = few(3, width=16, height=8, focal=10.0) if place.dry else make(ratio, 0)
            problem = state(scene, draws=2 if place.dry else 8)
            means, log_scales, quats, logits, sh = scene.groups(torch.float32)
            step = Step(means, log_scales, quats, logits, sh, where=place.device)
            image, _, _ = step.forward(
                scene.viewmat.float(), scene.K.float(), scene.width, scene.height, degree=3
            )
            color = image.cpu().double()
            by_group = step.gradients(problem.weights.float())
            outputs = {"image": color, **{k: x.cpu().double() for k, x in by_group.items()}}
            exact = {"image": problem.exact.image, **problem.exact.gradients}
            unit = {"image": problem.unit.image, **problem.unit.gradients}
            kept = ~problem.undecided
            for name, output in outputs.items():
                share = (output - exact[name].reshape(output.shape)).abs() / unit[name].reshape(output.shape)
                share = share[kept] if name == "image" else share
                yield {
                    "where": where, "ratio": ratio, "value": name,
                    "largest": float(share.max()), "median": float(share.median()),
                }  # fmt: skip
