"""A job as its stages see it: the arguments of `run`, the kernels chosen for them, and its folders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from splatmill.schema import Backend, LogEvent, Switch, TrainOptions
from splatmill_worker.errors import Refusal
from splatmill_worker.images.prepare import Prepared
from splatmill_worker.kernels.gpu.device import absence
from splatmill_worker.pipeline.events import Emit
from splatmill_worker.pipeline.live import Looks
from splatmill_worker.splat.lpips import Distances
from splatmill_worker.splat.plan.plan import Kernels


@dataclass(frozen=True)
class Job:
    """The arguments of `run`, which describes them, and the kernels chosen for them.

    kernels: the backend of the engine.
    looks: those of the onlookers; None where there are none.
    prepared: the photos as they were examined before; None: they are examined when their cameras are recovered.
    """

    capture: Path
    workdir: Path
    options: TrainOptions
    kernels: Kernels
    emit: Emit
    cancelled: Callable[[], bool]
    looks: Looks | None
    prepared: Prepared | None = None

    @property
    def keeps_time_lapse(self) -> bool:
        """Whether snapshots of the training are kept: of the jobs of a service, if nothing else is asked for."""
        asked = self.options.time_lapse
        return asked is Switch.on or (asked is Switch.auto and self.looks is not None)

    @property
    def out(self) -> Path:
        """The folder for what the job leaves."""
        return self.workdir / "out"

    @property
    def checkpoints(self) -> Path:
        """The folder of the checkpoints."""
        return self.workdir / "checkpoints"

    def warn(self, message: str) -> None:
        """Emit a warning."""
        self.emit(LogEvent(level="warning", message=message))

    def warn_of_idle_gpu(self) -> None:
        """Say why training runs on the CPU of a machine that has a GPU, where no option asks for the CPU."""
        if self.kernels == "cpu" and self.options.backend is Backend.auto and torch.cuda.is_available():
            self.warn(f"{absence()} Training runs on the CPU.")


def check_lpips(options: TrainOptions) -> None:
    """Raise Refusal where `lpips` asks for what this machine cannot measure, before hours are spent."""
    if options.lpips is not Switch.on:
        return
    try:
        Distances.read()
    except ValueError as error:
        raise Refusal(
            "option_out_of_range",
            f"The option lpips asks for LPIPS. {error}",
            advice="Or set lpips to auto, which leaves it out.",
        ) from error


def choose_kernels(options: TrainOptions) -> Kernels:
    """Return the kernels to train with: those that `backend` names; for auto, the GPU's if usable, else the CPU's.

    Raises Refusal when the requested ones do not run on this machine.
    """
    if options.backend is Backend.auto:
        return "gpu" if absence() is None else "cpu"
    if options.backend is Backend.gpu and (reason := absence()) is not None:
        raise Refusal(
            "backend_unavailable",
            f"The backend gpu was requested, but it does not run on this machine. {reason}",
            advice="Set backend to auto or cpu, or run a worker on a machine with a GPU.",
        )
    named: dict[Backend, Kernels] = {Backend.reference: "reference", Backend.cpu: "cpu", Backend.gpu: "gpu"}
    return named[options.backend]
