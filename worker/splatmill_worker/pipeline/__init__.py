"""The whole path of a capture: photos -> cameras -> plan -> training -> evaluation -> files."""

from splatmill_worker.pipeline.stages import Outcome, run

__all__ = ["Outcome", "run"]
