"""What a GPU step launches and asks of its device, watched in Triton's interpreter."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from splatmill_worker.kernels import gpu
from splatmill_worker.kernels.gpu.transfers.transfer import ToHost


class Launch(NamedTuple):
    """One launch: the kernel's name, and its arguments by name."""

    kernel: str
    arguments: dict[str, Any]


class _Pause:
    """Whether the modes below look away: within a kernel, whose interpreter calls torch as it likes."""

    depth = 0


@contextmanager
def looking_away() -> Iterator[None]:
    _Pause.depth += 1
    try:
        yield
    finally:
        _Pause.depth -= 1


class WatchedKernel:
    """A kernel that records its launches."""

    def __init__(self, name: str, kernel: Any, told: Callable[[Launch], None]) -> None:
        self.name, self.kernel, self._told = name, kernel, told
        function = kernel.fn if hasattr(kernel, "configs") else kernel
        self.parameters = inspect.signature(function.fn).parameters

    def __getitem__(self, grid: Any) -> Callable[..., None]:
        def launch(*arguments: Any, **named: Any) -> None:
            by_name = {**dict(zip(self.parameters, arguments, strict=False)), **named}
            with looking_away():
                self.kernel[grid](*arguments, **named)
                chosen = getattr(self.kernel, "best_config", None)
                self._told(Launch(self.name, {**by_name, **(chosen.kwargs if chosen is not None else {})}))

        return launch


def watch(monkeypatch: pytest.MonkeyPatch, told: Callable[[Launch], None]) -> dict[str, Any]:
    """Have every kernel of the package tell of its launches; returns the kernels themselves by name."""
    kernels: dict[str, Any] = {}
    names = [each.name for each in pkgutil.walk_packages(gpu.__path__, f"{gpu.__name__}.")]
    for module in [importlib.import_module(name) for name in names]:
        for name in [name for name in vars(module) if name.endswith("_kernel")]:
            kernels[name] = getattr(module, name)
            monkeypatch.setattr(module, name, WatchedKernel(name, kernels[name], told))
    return kernels


WAITING_METHODS = frozenset(
    (
        "cpu", "cuda", "numpy", "tolist", "item", "nonzero", "equal", "allclose", "is_nonzero", "unique",
        "masked_select", "__bool__", "__int__", "__float__", "__index__", "__contains__", "__array__",
    )
)  # fmt: skip
"""Methods and functions of torch that need values on the host."""

FROM_HOST = frozenset(["tensor", "as_tensor", "from_numpy"])
"""Functions that make a tensor of numbers on the host; on a device they wait for the copy."""

WAITING_OPERATIONS = frozenset(
    (
        "_local_scalar_dense", "nonzero", "nonzero_numpy", "masked_select", "unique", "_unique2", "unique_dim",
        "unique_consecutive", "bincount", "item", "equal", "is_nonzero", "repeat_interleave", "lift_fresh",
    )
)  # fmt: skip
"""Operations of ATen that read a value back, have a shape that depends on one, or bring numbers from the host."""


class _NoWaitingCalls(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if not _Pause.depth:
            assert name not in WAITING_METHODS | FROM_HOST, f"{name} waits for the device"
            if name == "to" and not (args[0].is_pinned() and (kwargs or {}).get("non_blocking")):
                moved = [
                    a for a in (*args[1:], *(kwargs or {}).values()) if isinstance(a, (str, torch.device))
                ]
                assert not moved, f"to({moved[0]}) may wait; transfer.to_device does not"
        return func(*args, **(kwargs or {}))


class _NoWaitingOperations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name().split("::")[1].split(".")[0]
        if not _Pause.depth:
            assert name not in WAITING_OPERATIONS, f"{name} waits for the device"
            if name in ("index", "index_put_"):
                masks = [i for i in args[1] if i is not None and i.dtype in (torch.bool, torch.uint8)]
                assert not masks, "a mask as index waits for the device"
        return func(*args, **(kwargs or {}))


@contextmanager
def nothing_waits() -> Iterator[None]:
    """Fail at whatever would make the host wait for a device: in the interpreter by what torch is called for, on a
    device by torch's own check of synchronisations as well.
    """
    with _no_synchronisation(), _NoWaitingCalls(), _NoWaitingOperations():
        yield


@contextmanager
def _no_synchronisation() -> Iterator[None]:
    """Have torch raise at a synchronisation with a device, where there is one."""
    if not torch.cuda.is_available():
        yield
        return
    before = torch.cuda.get_sync_debug_mode()
    try:
        with warnings.catch_warnings():  # it warns, once in a process, after the mode is set
            warnings.filterwarnings("ignore", "Synchronization debug mode is a prototype feature")
            torch.cuda.set_sync_debug_mode("error")
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)


class LateDevice:
    """Makes every copy to the host seem to be on its way until it is waited for; `waits` counts those waits."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.waits = 0
        device = self

        class Late(ToHost):
            @property
            def arrived(self) -> bool:
                return False

            def wait(self) -> list[float]:
                device.waits += 1
                with looking_away():
                    return super().wait()

        for module in ("step", "transfers.readback"):
            monkeypatch.setattr(f"{gpu.__name__}.{module}.ToHost", Late)


FREE = frozenset(
    (
        "view", "_unsafe_view", "reshape", "select", "slice", "t", "transpose", "permute", "unsqueeze",
        "squeeze", "expand", "as_strided", "detach", "alias", "unbind", "split", "empty", "empty_like",
        "new_empty", "empty_strided", "set_", "lift_fresh", "_reshape_alias", "is_pinned",
    )
)  # fmt: skip
"""Operations of ATen that enqueue nothing: views and allocations."""


class Enqueued(TorchDispatchMode):
    """Counts the operations of ATen that enqueue work, by name; sorts and sums are several launches on a device."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.name().split("::")[1].split(".")[0]
        if not _Pause.depth and name not in FREE:
            self.counts[name] += 1
        return func(*args, **(kwargs or {}))
