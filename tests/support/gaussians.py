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


def matched(actual: Gaussians, expected: Gaussians) -> Gaussians:
    """The rows of `expected` that are nearest to those of `actual`, which each is once."""
    nearest = torch.cdist(actual.means.double(), expected.means.double()).argmin(dim=1)
    assert len(nearest.unique()) == actual.count == expected.count
    return expected.select(nearest)


def differences(actual: Gaussians, expected: Gaussians) -> dict[str, float]:
    """The greatest difference of each parameter, row by row. That of `quats` is 1 - |cosine|, as q and -q are the same
    turn; that of opacities is between opacities, not logits."""
    assert actual.degree == expected.degree
    assert actual.count == expected.count
    mine, theirs = (torch.nn.functional.normalize(g.quats.double(), dim=1) for g in (actual, expected))
    return {
        "means": float((actual.means - expected.means).abs().max()),
        "log_scales": float((actual.log_scales - expected.log_scales).abs().max()),
        "quats": float((1 - (mine * theirs).sum(dim=1).abs()).max()),
        "opacities": float(
            (torch.sigmoid(actual.logit_opacities) - torch.sigmoid(expected.logit_opacities)).abs().max()
        ),
        "dc": float((actual.sh[:, 0] - expected.sh[:, 0]).abs().max()),
        "harmonics": float((actual.sh[:, 1:] - expected.sh[:, 1:]).abs().max()) if actual.degree else 0.0,
    }
