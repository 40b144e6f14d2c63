"""The whole path of a capture: photos -> cameras -> plan -> training -> evaluation -> files."""

from splatmill_worker.pipeline.job import Outcome, run

__all__ = ["Outcome", "run"]
