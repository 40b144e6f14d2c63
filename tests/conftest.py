"""What all tests share: threads of the kernels sleep soon at barriers, as they do in the worker's own processes, and
test processes that run side by side divide the cores between them."""

import os

from splatmill_worker.__main__ import SPIN_COUNT

os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if processes > 1:
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // processes)))
