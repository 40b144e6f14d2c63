"""No garbage is collected while a program imports its parts, and afterwards it is again.

Not proven here: how much time that saves (decisions: import-without-collection).
"""

import gc
import subprocess
import sys

import pytest

from splatmill.garbage import uncollected


def test_the_collector_rests_and_leaves_out_what_was_made() -> None:
    before = gc.get_freeze_count()
    with uncollected():
        assert not gc.isenabled()
        made: list[list[object]] = [[] for _ in range(1000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() >= before + len(made)


def test_the_collector_works_again_after_an_error() -> None:
    with pytest.raises(ImportError), uncollected():
        raise ImportError("no such part")
    assert gc.isenabled()


def test_the_program_of_the_service_starts_without_the_messages() -> None:
    """`splatmill up` only watches over other processes, which load them each."""
    ask = """import sys, splatmill_server.up.__main__
print(*{"pydantic", "httpx", "redis", "fastapi"} & sys.modules.keys())"""
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
