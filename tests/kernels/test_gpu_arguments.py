"""Every GPU kernel is launched with arguments of the types that it declares, for which `compiled` compiles it.

Says nothing about what the kernels compute (test_gpu_ops, test_gpu_step), nor whether they compile (test_gpu_compile).
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip(
    "triton", reason="Triton comes with torch's GPU builds; pip install triton to test the kernels here"
)

from splatmill_worker.kernels import gpu, ops
from splatmill_worker.kernels.gpu.argument import declared
from splatmill_worker.kernels.gpu.step import Step
from splatmill_worker.kernels.records import Rates
from tests.support.kernels.cases import scene

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


class Watched:
    """A kernel that compares the arguments of its launches with their declared types."""

    def __init__(self, kernel: Any) -> None:
        self.kernel = kernel
        function = kernel.fn if hasattr(kernel, "configs") else kernel
        self.parameters = inspect.signature(function.fn).parameters
        self.types = {
            name: declared(function, name)
            for name, parameter in self.parameters.items()
            if "constexpr" not in str(parameter.annotation)
        }
        self.launches = 0

    def __getitem__(self, grid: Any) -> Any:
        def launch(*arguments: Any, **named: Any) -> None:
            self.launches += 1
            given = {**dict(zip(self.parameters, arguments, strict=False)), **named}
            for name, kind in self.types.items():
                if given[name] is not None:
                    assert passed(given[name]) == kind, f"{name} of {self.kernel}"
            self.kernel[grid](*arguments, **named)

        return launch


def passed(value: Any) -> str:
    if isinstance(value, Tensor):
        return ARRAYS[value.dtype]
    return {int: "i32", float: "fp32"}[type(value)]


def test_launches_pass_the_declared_types(monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = {}
    for module in (
        importlib.import_module(f"{gpu.__name__}.{m.name}") for m in pkgutil.iter_modules(gpu.__path__)
    ):
        for name in [name for name in vars(module) if name.endswith("_kernel")]:
            kernels[name] = Watched(getattr(module, name))
            monkeypatch.setattr(module, name, kernels[name])
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
    ops.knn(groups[0].detach(), backend="gpu")
    means = groups[0].detach()
    moments = [torch.zeros_like(means) for _ in range(2)]
    seen, last = (
        torch.ones(6, dtype=torch.bool, device=DEVICE),
        torch.zeros(6, dtype=torch.int32, device=DEVICE),
    )
    ops.adam_(
        [means],
        [means],
        moments[:1],
        moments[1:],
        [1e-3],
        step=1,
        visible=seen,
        last_step=last,
        backend="gpu",
    )
    step = Step(*case.groups(), where=DEVICE)
    step.train(
        case.viewmat, case.K, photo, degree=0, rates=Rates(0.1, 0.1, 0.1, 0.1, 0.1, 0.1), step=1, mask=mask
    )
    assert {name for name, kernel in kernels.items() if not kernel.launches} == set()
