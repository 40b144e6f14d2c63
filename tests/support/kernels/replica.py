"""One of several processes that train a scene together.

`python -m tests.support.kernels.replica OUT reference:3 gpu:2` takes three steps with the reference and two with gpu.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.records import Rates
from splatmill_worker.splat.engine.parallel import Replicas, join, open_replica
from splatmill_worker.splat.gaussians import Gaussians
from tests.support.kernels.interpreter import ask_for_it

WIDTH, HEIGHT = 20, 12
RATES = Rates(means=1e-3, log_scales=5e-3, quats=1e-3, logit_opacities=5e-2, sh_dc=2.5e-3, sh_rest=1e-4)
K = torch.tensor([[18.0, 0.0, 9.7], [0.0, 19.0, 6.2], [0.0, 0.0, 1.0]])
BACKGROUND = torch.tensor([0.25, 0.5, 0.125])


def scene() -> Gaussians:
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        torch.randn(10, 3, generator=g) * torch.tensor([0.8, 0.5, 0.5]),
        torch.randn(10, 3, generator=g) * 0.4 - 1.8,
        torch.randn(10, 4, generator=g),
        torch.randn(10, generator=g),
        torch.randn(10, 16, 3, generator=g) * 0.3,
    )


def views() -> list[tuple[Tensor, Tensor]]:
    """Cameras along a line, each with a photo; the last ones miss Gaussians that the first ones see."""
    g = torch.Generator().manual_seed(1)
    found = []
    for i in range(4):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([-0.6 + 0.6 * i, 0.1 * i, 3.0])
        found.append((viewmat, torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)))
    return found


def train(engine: ops.Backend, steps: int, replicas: Replicas, out: Path) -> None:
    """Train the scene for some steps and leave what came out in `out`, in a file per engine and process."""
    if engine == "gpu":
        ask_for_it()
    step = open_replica(scene(), engine, replicas)
    mine = replicas.share(views())
    losses = []
    for number in range(1, steps + 1):
        viewmat, photo = mine[(number - 1) % len(mine)]
        seen = step.train_photo(viewmat, K, photo, degree=1, rates=RATES, step=number, background=BACKGROUND)
        losses.append(seen.loss)
    replicas.check_same(Gaussians(**step.parameters()))
    scores = torch.stack([step.plain_sum, step.visible_count, step.max_extent])
    found = {"parameters": step.parameters(), "losses": losses, "scores": scores}
    torch.save(found, out / f"{engine}.{replicas.rank}.pt")


def main(out: Path, *runs: str) -> None:
    replicas = join("gloo")
    for run in runs:
        engine, _, steps = run.partition(":")
        train("gpu" if engine == "gpu" else "reference", int(steps), replicas, out)
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
