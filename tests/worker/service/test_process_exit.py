"""Proves what an attempt's exit is called and advised on, with the wait statuses of real processes.

The kernel's count of processes killed for memory is given here: no test runs a machine out of memory.
"""

import os
import subprocess
import sys

import pytest

from splatmill_worker.service.process_exit import HANDED_BACK_STATUS, WITHDRAWN_STATUS, ProcessExit


def exit_of(code: str, oom_kills: int = 0) -> ProcessExit:
    """How a Python process that runs `code` exits."""
    process = subprocess.Popen([sys.executable, "-c", code])
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = 0  # waited for above
    return ProcessExit.of(status, usage, oom_kills)


def test_statuses_of_the_attempt_itself_are_told_apart() -> None:
    clean = exit_of("pass")
    handed_back = exit_of(f"import os; os._exit({HANDED_BACK_STATUS})")
    withdrawn = exit_of(f"import os; os._exit({WITHDRAWN_STATUS})")
    assert [one.clean for one in (clean, handed_back, withdrawn)] == [True, False, False]
    assert [one.handed_back for one in (clean, handed_back, withdrawn)] == [False, True, False]
    assert [one.withdrawn for one in (clean, handed_back, withdrawn)] == [False, False, True]
    assert clean.peak_bytes > 1_000_000


@pytest.mark.parametrize(
    ("code", "oom_kills", "cause", "problem", "facts"),
    [
        (
            "import os; os.kill(os.getpid(), 9)",
            0,
            "was killed by SIGKILL",
            "attempts_exhausted",
            {"signal": "SIGKILL"},
        ),
        (
            "import os; os.kill(os.getpid(), 9)",
            1,
            "ran out of memory and was killed by the kernel",
            "out_of_memory",
            {"signal": "SIGKILL"},
        ),
        (
            "import os; os._exit(3)",
            1,  # a kill of some other process
            "exited with status 3",
            "attempts_exhausted",
            {"exit_status": 3},
        ),
    ],
)
def test_an_early_exit_is_a_problem_with_its_cause(
    code: str, oom_kills: int, cause: str, problem: str, facts: dict[str, object]
) -> None:
    ended = exit_of(code, oom_kills)
    assert ended.cause == cause
    told = ended.problem(attempts=4)
    assert told.code == problem
    assert told.facts == {"attempts": 4, "peak_memory_bytes": ended.peak_bytes, **facts}
    assert told.detail.startswith(f"All 4 attempts ended early. In the last one, the job's process {cause}.")
    assert told.advice
