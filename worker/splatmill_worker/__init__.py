"""The worker: the engine, the queue worker and the renderer. `import splatmill_worker as sm` offers the engine's names.

A name is imported when it is first used, so that the programs of the worker start with what they need.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # `as` exports a name to type checkers
    from splatmill_worker.images.load import load_views as load_views
    from splatmill_worker.kernels import ops as ops
    from splatmill_worker.pipeline import run as run
    from splatmill_worker.scene import Camera as Camera
    from splatmill_worker.scene import Normalization as Normalization
    from splatmill_worker.scene import Scene as Scene
    from splatmill_worker.scene import View as View
    from splatmill_worker.scene import split as split
    from splatmill_worker.sfm import SfmOptions as SfmOptions
    from splatmill_worker.sfm import reconstruct as reconstruct
    from splatmill_worker.splat.engine.open import open_engine as open_engine
    from splatmill_worker.splat.evaluate import evaluate as evaluate
    from splatmill_worker.splat.formats.registry import read as read
    from splatmill_worker.splat.formats.registry import write as write
    from splatmill_worker.splat.gaussians import Gaussians as Gaussians
    from splatmill_worker.splat.plan.rates import Annealing as Annealing
    from splatmill_worker.splat.plan.rates import RateSchedule as RateSchedule
    from splatmill_worker.splat.render import render as render
    from splatmill_worker.splat.start.points import from_points as from_points
    from splatmill_worker.splat.views import TrainingView as TrainingView

_MODULES = {
    "Annealing": "splat.plan.rates",
    "Camera": "scene",
    "Gaussians": "splat.gaussians",
    "Normalization": "scene",
    "RateSchedule": "splat.plan.rates",
    "Scene": "scene",
    "SfmOptions": "sfm",
    "TrainingView": "splat.views",
    "View": "scene",
    "evaluate": "splat.evaluate",
    "from_points": "splat.start.points",
    "load_views": "images.load",
    "open_engine": "splat.engine.open",
    "ops": "kernels",
    "read": "splat.formats.registry",
    "reconstruct": "sfm",
    "render": "splat.render",
    "run": "pipeline",
    "split": "scene",
    "write": "splat.formats.registry",
}

if not TYPE_CHECKING:
    __all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    module = _MODULES.get(name)
    if module is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    return [*_MODULES]
