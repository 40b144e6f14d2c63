"""The owner who abuses the service in every way at once, in a process of its own.

    python -m _abuse.abuser '{"url": ..., "key": ..., "capture": ..., "model": ..., "link": ...,
                              "photo": ..., "read_key": ...}'

It runs until its input ends. Then the last line of its output is JSON: how many answers of each status every abuse
got. All that is asked for is what the HTTP API offers to every owner with a key.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import json
import sys
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx

from _abuse.hosts import Host

_NEVER = "9999999999999999999-0"
FORGED = f"{_NEVER}_{_NEVER}_2_{_NEVER}_{_NEVER}_{_NEVER}"
"""A position that Redis will never reach, as the id of the last event that a client has received."""

FOLLOWERS = 10
CAPTURES = 3
EDITS = 14
HOOKS = 20
VISITORS = 8

FORMATS = ("compressed.ply", "spz", "sog", "glb")

CAMERA = "1,0,0,0,0,1,0,0,0,0,1,-4,0,0,0,1"
"""The camera of rendered pictures, four units in front of the origin."""


class Abuser:
    """What is abused, and how often what was answered."""

    def __init__(self, asked: dict[str, Any], http: httpx.AsyncClient, host: Host) -> None:
        self.http, self.host = http, host
        self.capture, self.model, self.link = asked["capture"], asked["model"], asked["link"]
        self.photo = Path(asked["photo"])
        self.reading = {"Authorization": f"Bearer {asked['read_key']}"}
        self.answers: Counter[str] = Counter()

    async def ask(self, what: str, method: str, path: str, **request: Any) -> httpx.Response | None:
        """Send a request, and count its answer."""
        try:
            answer = await self.http.request(method, path, **request)
        except httpx.HTTPError as error:
            self.answers[f"{what} {type(error).__name__}"] += 1
            await asyncio.sleep(0.2)
            return None
        self.answers[f"{what} {answer.status_code}"] += 1
        return answer

    async def _made(self, what: str, path: str, body: dict[str, Any]) -> str:
        """Return the id of a new record, which is asked for until there is room for it."""
        while True:
            made = await self.ask(what, "POST", path, json=body)
            if made is not None and made.is_success:
                return str(made.json()["id"])
            await asyncio.sleep(0.5)

    async def events(self) -> None:
        """Follow each job of the other owner before anybody else does, from a position that is never reached.

        The key for it may only read. It is that of somebody who was to see the jobs.
        """
        known: set[str] = set()
        async with asyncio.TaskGroup() as followers:
            while True:
                listed = await self.ask("list", "GET", "/v1/jobs?limit=5", headers=self.reading)
                jobs = listed.json()["jobs"] if listed is not None and listed.is_success else []
                for job in {each["id"] for each in jobs} - known:
                    known.add(job)
                    for _ in range(FOLLOWERS):
                        followers.create_task(self._follow(f"/v1/jobs/{job}/events"))
                await asyncio.sleep(0.1)

    async def _follow(self, path: str) -> None:
        headers = self.reading | {"Last-Event-ID": FORGED}
        try:
            async with self.http.stream("GET", path, headers=headers, timeout=600) as stream:
                self.answers[f"events {stream.status_code}"] += 1
                async for _ in stream.aiter_lines():
                    pass
        except httpx.HTTPError as error:
            self.answers[f"events {type(error).__name__}"] += 1

    def _job(self) -> dict[str, Any]:
        return {"capture": self.capture, "options": {"steps": 1}}

    async def uploads(self) -> None:
        """Send the file that the other owner sends, in pieces, into several captures at once."""
        content = self.photo.read_bytes()
        headers = {
            "Upload-Complete": "?0",
            "Upload-Length": str(len(content)),
            "X-Content-SHA256": hashlib.sha256(content).hexdigest(),
        }
        await asyncio.gather(*(self._upload(content, headers) for _ in range(CAPTURES)))

    async def _upload(self, content: bytes, headers: dict[str, str]) -> None:
        path = f"/v1/captures/{await self._made('capture', '/v1/captures', {})}/images/{self.photo.name}"
        while True:
            begun = await self.ask("upload", "PUT", path, headers=headers)
            if begun is None or "Location" not in begun.headers:
                await asyncio.sleep(0.5)
                continue
            upload, size = begun.headers["Location"], len(content) // 8
            for number in range(4):
                await self.ask(
                    "append",
                    "PATCH",
                    upload,
                    headers={
                        "Upload-Offset": str(number * size),
                        "Upload-Complete": "?0",
                        "Content-Type": "application/partial-upload",
                    },
                    content=content[number * size : (number + 1) * size],
                )
                await self.ask("append", "HEAD", upload)
            await self.ask("append", "DELETE", upload)

    async def imports(self) -> None:
        """Have files fetched that never arrive, into new captures when one takes no more."""
        while True:
            capture = await self._made("capture", "/v1/captures", {})
            for number in range(30):
                kind = ("slow", "endless", "later")[number % 3]
                body = {"url": f"{self.host.url}/{kind}?{number}", "name": f"{number}.jpg"}
                await self.ask("import", "POST", f"/v1/captures/{capture}/import", json=body)
            await asyncio.sleep(5)

    async def webhooks(self) -> None:
        """Have the end of each job told to many receivers that never answer."""
        for number in range(HOOKS):
            await self.ask("webhook", "POST", "/v1/webhooks", json={"url": f"{self.host.url}/hang?{number}"})
        while True:
            job = await self._made("job", "/v1/jobs", self._job())
            await self.ask("cancel", "POST", f"/v1/jobs/{job}/cancel")
            await asyncio.sleep(0.5)

    async def edits(self) -> None:
        """Make many models of one at the same moment, convert them, and delete them."""
        for number in itertools.count():
            body = {"min_opacity": 0.001 + 1e-6 * (number % 1000)}
            made = await asyncio.gather(
                *(self.ask("edit", "POST", f"/v1/models/{self.model}/edits", json=body) for _ in range(EDITS))
            )
            new = [each.json()["model"] for each in made if each is not None and each.status_code == 201]
            paths = [f"/v1/models/{model}/download/{form}" for model in new for form in FORMATS]
            await asyncio.gather(*(self.ask("convert", "HEAD", path) for path in paths))
            await asyncio.gather(*(self.ask("delete", "DELETE", f"/v1/jobs/{model}") for model in new))
            await asyncio.sleep(0.2)

    async def orbits(self) -> None:
        """Ask for many videos of a model at the same moment, and delete them."""
        path = f"/v1/models/{self.model}/orbits"
        for number in itertools.count():
            bodies = [
                {"seconds": 1, "fps": 4, "width": 320 + 2 * (number % 50), "height": 200 + 2 * k}
                for k in range(8)
            ]
            made = await asyncio.gather(*(self.ask("orbit", "POST", path, json=body) for body in bodies))
            await asyncio.sleep(5)
            for each in made:
                if each is not None and each.is_success:
                    await self.ask("delete", "DELETE", f"{path}/{each.json()['id']}")

    async def restarts(self) -> None:
        """Restart a cancelled job from many connections at the same moment, and cancel it."""
        path = f"/v1/jobs/{await self._made('job', '/v1/jobs', self._job())}"
        while True:
            await self.ask("cancel", "POST", f"{path}/cancel")
            await asyncio.sleep(0.5)
            await asyncio.gather(*(self.ask("restart", "POST", f"{path}/restart") for _ in range(8)))

    async def shared(self) -> None:
        """Load a link from many connections."""
        await asyncio.gather(*(self._visit(number) for number in range(VISITORS)))

    async def _visit(self, number: int) -> None:
        base = f"{self.link}/model"
        for turn in itertools.count(number):
            camera = {
                "camera_to_world": CAMERA,
                "fov_y_deg": 50,
                "width": 320 + 2 * (turn % 64),
                "height": 240,
            }
            await self.ask("link", "GET", f"{base}/download/{FORMATS[turn % len(FORMATS)]}")
            await self.ask("link", "GET", f"{base}/render", params=camera)

    @property
    def abuses(self) -> list[Callable[[], Awaitable[None]]]:
        """All of them, which run at once."""
        return [
            *(self.events, self.uploads, self.imports, self.webhooks),
            *(self.edits, self.orbits, self.restarts, self.shared),
        ]


async def main(asked: dict[str, Any]) -> None:
    """Abuse the service until the input ends."""
    host = Host(b"")
    server = await host.listen()
    http = httpx.AsyncClient(
        base_url=asked["url"],
        headers={"Authorization": f"Bearer {asked['key']}"},
        timeout=30,
        trust_env=False,
        limits=httpx.Limits(max_connections=None, max_keepalive_connections=50),
    )
    abuser = Abuser(asked, http, host)
    tasks = [asyncio.ensure_future(abuse()) for abuse in abuser.abuses]
    end = asyncio.ensure_future(asyncio.to_thread(sys.stdin.read))
    await asyncio.wait([*tasks, end], return_when=asyncio.FIRST_COMPLETED)
    ended = [task for task in tasks if task.done()]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    server.close()
    for task in ended:
        raise RuntimeError("An abuse has ended, which is a fault of this program.") from task.exception()
    print(json.dumps(dict(sorted(abuser.answers.items()))), flush=True)


if __name__ == "__main__":
    asyncio.run(main(json.loads(sys.argv[1])))
