"""The training loop on the GPU engine, with densification and evaluation, ends where it ends on the CPU engine.

Three steps on twelve rows of pixels, in Triton's interpreter where there is no GPU. Proves nothing about quality.
"""

from __future__ import annotations

import pytest
import torch

from splatmill_worker.scene import Camera
from splatmill_worker.splat.engine.open import open_engine
from splatmill_worker.splat.plan import schedule as schedule_module
from splatmill_worker.splat.plan.budget import Budget
from splatmill_worker.splat.plan.plan import Kernels, Plan
from splatmill_worker.splat.plan.schedule import Schedule
from splatmill_worker.splat.train.loop import Trained, train
from splatmill_worker.splat.views import Target, TrainingView
from tests.support.kernels import replica

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to prove this here"
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the interpreter's numpy, in lanes that are masked
]
STEPS = 3


def views() -> list[TrainingView]:
    found = []
    for number, (viewmat, photo) in enumerate(replica.views()):
        camera = Camera(
            replica.WIDTH, replica.HEIGHT, float(replica.K[0, 0]), float(replica.K[1, 1]), float(replica.K[0, 2]),
            float(replica.K[1, 2]), viewmat.double().numpy(),
        )  # fmt: skip
        found.append(
            TrainingView(f"{number}.png", {1: Target(camera, viewmat, replica.K, photo, None, None)})
        )
    return found


def run(kernels: Kernels, dropout: float) -> Trained:
    schedule = Schedule(
        budget=Budget(STEPS, None), resolution=((0, 1),), degree=1, densify_from=2, densify_every=2,
        densify_until=0.9, expected_steps=STEPS, dropout=dropout,
    )  # fmt: skip
    plan = Plan(
        schedule=schedule, image_size=replica.WIDTH, max_gaussians=14, densify=True, initial="points",
        kernels=kernels, background="black", exposure=False, antialias=False, target_psnr=None, max_memory=None,
        stops_when_flat=False, seed=0,
    )  # fmt: skip
    shown = views()
    return train(open_engine(replica.scene(), kernels), shown[1:], shown[:1], plan, extent=1.1)


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
    assert gpu.gaussians.count == cpu.gaussians.count > replica.scene().count, "nothing was densified"
    for name, value in cpu.gaussians.parameters().items():
        seen = gpu.gaussians.parameters()[name]
        assert seen.device.type == "cpu", "what is handed on must not live on the device"
        # Three Adam steps with float32 gradients in another order of summation.
        assert (seen - value).abs().max().item() <= 1e-4, name
    assert gpu.held_out is not None
    assert cpu.held_out is not None
    assert gpu.held_out.psnr == pytest.approx(cpu.held_out.psnr, abs=1e-2)
    assert torch.isfinite(torch.tensor([point.loss for point in gpu.curve])).all()
