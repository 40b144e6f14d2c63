"""pytest plugin: the engine's sanitized builds under the names of the installed ones, before anything imports those."""

import importlib.util
import os
import sys
from pathlib import Path

import splatmill_worker.kernels  # noqa: F401  # the package that the modules belong to

for path in Path(os.environ["SPLATMILL_SANITIZED"]).glob("_cpu_*.so"):
    name = f"splatmill_worker.kernels.cpu.{path.name.split('.')[0]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None, path
    assert spec.loader is not None, path
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])
