"""Every GPU kernel is launched with arguments of the types that it declares, for which `compiled` compiles it.

Says nothing about what the kernels compute (test_gpu_ops, test_gpu_step), nor whether they compile (test_gpu_compile).
"""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to test the kernels here"
)

from splatmill_worker.kernels import ops
from splatmill_worker.kernels.gpu.launch.argument import declared
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import scene
from tests.support.kernels.launches import Launch, watch

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's, in lanes that are masked
]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
ARRAYS = {
    torch.float32: "*fp32",
    torch.uint8: "*u8",
    torch.int16: "*i16",
    torch.int32: "*i32",
    torch.int64: "*i64",
}


def passed(value: Any) -> str:
    if isinstance(value, Tensor):
        return ARRAYS[value.dtype]
    return {int: "i32", float: "fp32"}[type(value)]


def test_launches_pass_the_declared_types(monkeypatch: pytest.MonkeyPatch) -> None:
    launched: set[str] = set()

    def compare(launch: Launch) -> None:
        kernel = kernels[launch.kernel]
        function = kernel.fn if hasattr(kernel, "configs") else kernel
        for name, parameter in inspect.signature(function.fn).parameters.items():
            if "constexpr" not in str(parameter.annotation) and launch.arguments[name] is not None:
                actual, expected = passed(launch.arguments[name]), declared(function, name)
                assert actual == expected, f"{name} of {launch.kernel}"
        launched.add(launch.kernel)

    kernels = watch(monkeypatch, compare)
    case = scene("types", 6, width=17, height=5)
    groups = [group.to(DEVICE).requires_grad_() for group in case.groups()]
    viewmat = case.viewmat.to(DEVICE).requires_grad_()
    photo = torch.zeros(5, 17, 3, dtype=torch.uint8, device=DEVICE)
    mask = torch.ones(5, 17, dtype=torch.bool, device=DEVICE)

    projected = case.project(groups, viewmat, "gpu")
    bins = ops.bin(projected, 17, 5, backend="gpu")
    color, alpha, depth = ops.composite(
        projected, bins, 17, 5, background=case.background.to(DEVICE), backend="gpu"
    )
    stats = ops.photo_stats(photo, mask=mask, backend="gpu")
    loss = ops.loss(color, photo, mask=mask, stats=stats, backend="gpu") + alpha.sum() + depth.sum()
    loss.backward()
    ops.median_depth(projected, bins, 17, 5, backend="gpu")
    ops.knn(groups[0].detach(), backend="gpu")
    step = Step(*case.groups(), where=DEVICE)
    step.train(
        case.viewmat, case.K, photo, degree=0, rates=Rates(0.1, 0.1, 0.1, 0.1, 0.1, 0.1), step=1, mask=mask,
        alpha=photo[..., 0].contiguous(),
    )  # fmt: skip
    assert launched == set(kernels)
