"""What all tests share: threads of the kernels sleep soon at barriers, as they do in the worker's own processes."""

import os

from splatmill_worker.__main__ import SPINS

os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
