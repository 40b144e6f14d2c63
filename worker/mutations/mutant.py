"""pytest plugin: one module of the kernels is replaced by a mutated build or source, before anything imports it.

SPLATMILL_MUTANT is MODULE=PATH, with the path of an extension module or of a Python file; empty for no mutant.
"""

import importlib.util
import os
import sys
from importlib.machinery import ModuleSpec

module, _, path = os.environ["SPLATMILL_MUTANT"].partition("=")


class Finder:
    """Finds the mutated module, and nothing else."""

    @staticmethod
    def find_spec(name: str, search: object = None, target: object = None) -> ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, path) if name == module else None


assert module not in sys.modules, "imported before the plugin was loaded"
sys.meta_path.insert(0, Finder)


def pytest_sessionfinish() -> None:
    """End with a failure where the tests never loaded the mutant: they would prove nothing about it."""
    loaded = sys.modules.get(module)
    assert loaded is None or loaded.__file__ == path, f"{module} was loaded from {loaded.__file__}"
