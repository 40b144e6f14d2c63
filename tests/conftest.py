"""What all tests share.

Hypothesis draws the same values in every run, whatever else its process has imported. Threads of the kernels sleep
soon at barriers, as they do in the worker's own processes. Test processes that run side by side divide the cores
between them. No garbage is looked for while tests are collected. A umask that a command sets in the process of its test
is taken back, and so is what a test sets of the log.
"""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from hypothesis import settings
from hypothesis.internal.conjecture import providers

from splatmill_worker.__main__ import SPIN_COUNT

os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if processes > 1:
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // processes)))

settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
# It also draws numbers that stand in the source of the modules that are loaded. Which these are depends on the tests
# that ran before in the same process.
vars(providers)["_get_local_constants"] = type(providers._local_constants)

# Collecting the tests makes millions of objects, and all of them stay: to look through them takes a third of the time.
gc.disable()


def pytest_collection_finish() -> None:
    """The collector begins its work, and leaves out the objects made so far."""
    gc.freeze()
    gc.enable()


FOLDER = Path(__file__).parent

LONGEST = (
    "service/test_kills.py",
    "docs/test_blocks.py",
    "packaging/test_wheels.py",
    "inputs/test_video_variants.py",
    "client/cli/test_unfinished.py",
    "worker/pipeline/test_decision_pairs.py",
    "hostile/test_hostile.py",
    "service/test_soak.py",
    "service/test_up.py",
    "bench/test_train.py",
)
"""Files that take over a minute by themselves, the longest first; the first mostly waits."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, then those with slow tests, so that no process is left alone with one at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    first = {FOLDER / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (first.get(item.path, len(first)), item.path not in slow))


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(0o022)
    os.umask(before)
    yield
    os.umask(before)


@pytest.fixture(autouse=True)
def _log() -> Iterator[None]:
    before = structlog.get_config()
    yield
    structlog.configure(**before)
