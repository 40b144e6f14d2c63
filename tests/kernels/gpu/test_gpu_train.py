"""The training loop on the GPU engine, with densification and evaluation, ends where it ends on the CPU engine.

Three steps on twelve rows of pixels, in Triton's interpreter where there is no GPU. Proves nothing about quality.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan import schedule as schedule_module
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.schedule import Schedule
from splatmill_worker.splat.train.loop import Trained, train
from splatmill_worker.splat.views import Target, TrainingView

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove this here"
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, in lanes that are masked
]
STEPS = 3
WIDTH, HEIGHT = 20, 12
K = torch.tensor([[18.0, 0.0, 9.7], [0.0, 19.0, 6.2], [0.0, 0.0, 1.0]])


def scene() -> Gaussians:
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        torch.randn(10, 3, generator=g) * torch.tensor([0.8, 0.5, 0.5]),
        torch.randn(10, 3, generator=g) * 0.4 - 1.8,
        torch.randn(10, 4, generator=g),
        torch.randn(10, generator=g),
        torch.randn(10, 16, 3, generator=g) * 0.3,
    )


def views() -> list[TrainingView]:
    """Cameras along a line, each with a photo; the last ones miss Gaussians that the first ones see."""
    g = torch.Generator().manual_seed(1)
    shown = []
    for i in range(4):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([-0.6 + 0.6 * i, 0.1 * i, 3.0])
        photo = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)
        focal = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        camera = Camera(WIDTH, HEIGHT, *focal, viewmat.double().numpy())
        shown.append(TrainingView(f"{i}.png", {1: Target(camera, viewmat, K, photo, None, None)}))
    return shown


def run(kernels: Kernels, dropout: float) -> Trained:
    schedule = Schedule(
        budget=Budget(STEPS, None), resolution=((0, 1),), degree=1, densify_from=2, densify_every=2,
        densify_until=0.9, expected_steps=STEPS, dropout=dropout,
    )  # fmt: skip
    plan = Plan(
        schedule=schedule, image_size=WIDTH, max_gaussians=14, densify=True, initial="points",
        kernels=kernels, background="black", exposure=False, antialias=False, target_psnr=None, max_memory=None,
        stops_when_flat=False, seed=0,
    )  # fmt: skip
    shown = views()
    return train(open_engine(scene(), kernels), shown[1:], shown[:1], plan, extent=1.1)


@pytest.mark.parametrize(
    "dropout",
    [
        0.0,
        pytest.param(0.5, marks=pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU draws others")),
    ],
)
def test_training_on_the_gpu_engine_ends_where_the_cpu_engine_ends(
    dropout: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schedule_module, "MANY_VISITS", 0.1)  # so that the first steps leave Gaussians out
    gpu, cpu = run("gpu", dropout), run("cpu", dropout)
    assert gpu.steps == cpu.steps == STEPS
    assert gpu.gaussians.count == cpu.gaussians.count > scene().count, "nothing was densified"
    for name, value in cpu.gaussians.parameters().items():
        parameter = gpu.gaussians.parameters()[name]
        assert parameter.device.type == "cpu", "what is handed on must not live on the device"
        # Three Adam steps with float32 gradients in another order of summation.
        assert (parameter - value).abs().max().item() <= 1e-4, name
    assert gpu.held_out is not None
    assert cpu.held_out is not None
    assert gpu.held_out.psnr == pytest.approx(cpu.held_out.psnr, abs=1e-2)
    assert torch.isfinite(torch.tensor([point.loss for point in gpu.curve])).all()
