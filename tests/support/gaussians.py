"""Random Gaussians without any symmetry, and a comparison of what two files hold whatever the order of their rows."""

import torch

from splatmill_worker.splat.gaussians import Gaussians


def some_gaussians(n: int, degree: int, seed: int = 0) -> Gaussians:
    """Gaussians of all shapes and turns; all visible; harmonics within 1 for the most part."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    sh = normal(n, (degree + 1) ** 2, 3) * 0.3
    return Gaussians(normal(n, 3), normal(n, 3) - 3, normal(n, 4), (normal(n) * 2).clamp(-5, 5), sh)


def matched(found: Gaussians, wanted: Gaussians) -> Gaussians:
    """The rows of `wanted` that are nearest to those of `found`, which each is once."""
    nearest = torch.cdist(found.means.double(), wanted.means.double()).argmin(dim=1)
    assert len(nearest.unique()) == found.count == wanted.count
    return wanted.select(nearest)


def differences(found: Gaussians, wanted: Gaussians) -> dict[str, float]:
    """The greatest difference of each parameter, row by row. That of `quats` is 1 - |cosine|, as q and -q are the same
    turn; that of opacities is between opacities, not logits."""
    assert found.degree == wanted.degree
    assert found.count == wanted.count
    mine, theirs = (torch.nn.functional.normalize(g.quats.double(), dim=1) for g in (found, wanted))
    return {
        "means": float((found.means - wanted.means).abs().max()),
        "log_scales": float((found.log_scales - wanted.log_scales).abs().max()),
        "quats": float((1 - (mine * theirs).sum(dim=1).abs()).max()),
        "opacities": float(
            (torch.sigmoid(found.logit_opacities) - torch.sigmoid(wanted.logit_opacities)).abs().max()
        ),
        "dc": float((found.sh[:, 0] - wanted.sh[:, 0]).abs().max()),
        "harmonics": float((found.sh[:, 1:] - wanted.sh[:, 1:]).abs().max()) if found.degree else 0.0,
    }
