"""Proves that the lines of unfinished work can be asked for by any thread while they are read anew.

Not proved here: the work itself, its pauses and its end (test_imports_fair, test_orbits).
"""

import asyncio
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import redis

from splatmill.backplane.storage.storage import Storage
from splatmill_server.base.turns import Turns
from splatmill_server.base.unfinished import Unfinished


@pytest.fixture
def eager_threads() -> Iterator[None]:
    """Let threads alternate after a microsecond, in place of five milliseconds."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("eager_threads")
def test_lines_can_be_asked_for_while_the_marks_are_read(tmp_path: Path, connection: redis.Redis) -> None:
    async def work(name: str) -> float | None:
        return None

    unfinished = Unfinished(
        connection,
        Storage(tmp_path.as_uri()),
        "piece",
        "marks",
        work,
        line=lambda name: f"line of {name}",
        exists=lambda name: True,
        turns=Turns(1, 1),
        look_seconds=1.0,
    )

    async def run_and_ask() -> None:
        """Change what runs, as the event loop does, and ask for lines, as requests do."""
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(1) as pool:
            reading = loop.run_in_executor(pool, lambda: [unfinished._marked() for _ in range(3000)])
            number = 0
            while not reading.done():
                number += 1
                name = f"{number % 5000:016x}"
                assert unfinished.line_of(name) == f"line of {name}"
                unfinished.running[name] = asyncio.current_task()  # type: ignore[assignment]  # any task
                unfinished.running.pop(f"{number * 7 % 5000:016x}", None)
                if number % 100 == 0:
                    await asyncio.sleep(0)
            await reading

    asyncio.run(run_and_ask())
