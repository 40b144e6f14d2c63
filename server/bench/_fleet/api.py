"""The API in this process: it takes jobs, and its reaper looks after them."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import httpx
from _capacity.operations import counted

from _fleet.pipeline import SCRIPT
from splatmill.backplane import keys
from splatmill_server.app import create_app
from splatmill_server.base.settings import Settings
from splatmill_server.jobs import shrinking
from splatmill_server.service import Service

LOOK_SECONDS = 2.0
"""Seconds between two looks of the reaper while jobs end. The service takes ten by default."""

_AT_ONCE = 4  # requests


class Api:
    """The app and its service."""

    def __init__(self, settings: Settings) -> None:
        self.app = create_app(settings)
        self.service: Service = self.app.state.service
        self.service.lists.ensure(0.0)

    def capture(self, until: Path | None) -> str:
        """Create a capture whose jobs train until a file is there, or end at once, and return its id."""

        async def create() -> str:
            async with self._client() as http:
                made = (await http.post("/v1/captures", json={})).raise_for_status().json()["id"]
                script = json.dumps({"until": None if until is None else str(until)}).encode()
                answer = await http.put(f"/v1/captures/{made}/images/{SCRIPT}", content=script)
                answer.raise_for_status()
                return str(made)

        return asyncio.run(create())

    def create(self, capture: str, count: int) -> None:
        """Create jobs on a capture, some at a time."""

        async def create() -> None:
            left = iter(range(count))
            async with self._client() as http:

                async def some() -> None:
                    for _ in left:
                        (await http.post("/v1/jobs", json={"capture": capture})).raise_for_status()

                await asyncio.gather(*(some() for _ in range(_AT_ONCE)))

        asyncio.run(create())

    def page(self, state: str) -> dict[str, Any]:
        """Ask for a page of jobs in a state, and return what it took: CPU seconds, round trips, and jobs on it."""

        async def ask() -> dict[str, Any]:
            async with self._client() as http:
                with counted() as operations:
                    cpu = time.process_time()
                    answer = await http.get("/v1/jobs", params={"state": state, "limit": 50})
                    cpu = time.process_time() - cpu
                jobs = len(answer.raise_for_status().json()["jobs"])
                return {"cpu_seconds": cpu, "round_trips": operations.round_trips, "found": jobs}

        return asyncio.run(ask())

    def require_none_failed(self) -> None:
        """Raise RuntimeError with the problem of a job that has failed: what it cost says nothing."""

        async def ask() -> None:
            async with self._client() as http:
                answer = await http.get("/v1/jobs", params={"state": "failed", "limit": 1})
            for job in answer.raise_for_status().json()["jobs"]:
                raise RuntimeError(f"The job {job['id']} of the fleet has failed: {job['problem']['detail']}")

        asyncio.run(ask())

    def shrink(self) -> None:
        """Shrink the streams of all jobs that have ended, as the reaper does after a minute."""
        redis = self.service.redis
        for member in cast(list[bytes], redis.zrange(keys.UNSHRUNK, 0, -1)):
            shrinking.shrink(redis, member.decode())

    def look(self) -> dict[str, Any]:
        """Let the reaper look once, and return what it took: CPU seconds of this process and round trips."""
        with counted() as operations:
            cpu = time.process_time()
            self.service.reaper.tick()
            cpu = time.process_time() - cpu
        return {"cpu_seconds": cpu, "round_trips": operations.round_trips}

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Let the reaper look every LOOK_SECONDS, in a thread."""
        done = threading.Event()

        def run() -> None:
            while not done.wait(LOOK_SECONDS):
                self.service.reaper.tick()

        thread = threading.Thread(target=run, name="reaper", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def _client(self) -> httpx.AsyncClient:
        transport = httpx.ASGITransport(app=self.app)
        return httpx.AsyncClient(transport=transport, base_url="http://localhost", timeout=600)
