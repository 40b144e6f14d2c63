"""The embedded service as a whole: which children there are, how they start, and in what order they end."""

import http.client
import importlib.util
import json
import os
import selectors
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

from splatmill_server.up import redis_server
from splatmill_server.up.child import Child
from splatmill_server.up.folder import DataFolder, UpError

WORKER = "splatmill_worker"

READY_SECONDS = 60.0
"""A first start on a cold disk reads a few hundred megabytes of libraries."""

_WORKER_PATIENCE = 20.0
_POLL = 0.02
_GIVE_UP_DEATHS = 5


class Service:
    """Children of one data folder behind one listening socket. `say` takes lines for the operator.

    Raises UpError when a part or Redis is not installed.
    """

    def __init__(self, folder: DataFolder, listener: socket.socket, say: Callable[[str], None]) -> None:
        if importlib.util.find_spec(WORKER) is None:
            raise UpError(
                "The part splatmill-worker, which trains and renders, is not installed: pip install splatmill-worker."
            )
        self.folder = folder
        self.say = say
        self._address = listener.getsockname()[:2]
        environment = dict(os.environ)
        environment |= {
            "SPLATMILL_DATA": str(folder.path),
            "SPLATMILL_RENDERER_URL": f"unix:{folder.renderer_socket}",
            "PYTHONUNBUFFERED": "1",
        }
        environment.setdefault("SPLATMILL_STORAGE", (folder.path / "storage").as_uri())
        own_redis = not environment.get("REDIS_URL")
        if own_redis:
            environment["REDIS_URL"] = f"unix://{folder.redis_socket}"

        def child(name: str, command: list[str], patience: float, **more: object) -> Child:
            return Child(name, command, environment, lambda: folder.log(name), patience, **more)  # type: ignore[arg-type]

        python = sys.executable
        self.worker = child("worker", [python, "-m", WORKER, "train"], _WORKER_PATIENCE)
        renderer = [python, "-m", WORKER, "renderer", "--uds", str(folder.renderer_socket)]
        self.renderer = child("renderer", renderer, 3.0)
        api = [python, "-m", "splatmill_server.up.api", str(listener.fileno())]
        self.api = child("api", api, 6.0, inherited=(listener.fileno(),))
        self.redis: Child | None = None
        if own_redis:
            # SIGTERM: Redis closes its log and goes. Holding the lock, it keeps the folder taken until it has.
            self.redis = child(
                "redis", redis_server.command(folder), 10.0, at_death=signal.SIGTERM, inherited=(folder.lock,)
            )
        self.children = [c for c in (self.redis, self.api, self.worker, self.renderer) if c is not None]
        self._signals = 0
        self._wake, wake_end = socket.socketpair()
        self._wake.setblocking(False)
        wake_end.setblocking(False)
        self._wake_end = wake_end

    def run(self, ready: Callable[[], None], until_closed: int | None = None) -> None:
        """Start everything, call `ready` once requests are answered, and keep it up until a signal comes, or the
        file `until_closed` ends. Returns when no child is left. Raises UpError when it does not become ready."""
        signal.set_wakeup_fd(self._wake_end.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        signal.signal(signal.SIGCHLD, lambda *_: None)  # only to wake the loop
        waiting = selectors.DefaultSelector()
        waiting.register(self._wake, selectors.EVENT_READ)
        if until_closed is not None:
            waiting.register(until_closed, selectors.EVENT_READ)
        announced, deadline = False, time.monotonic() + READY_SECONDS
        try:
            while not self._signals:
                self._tend()
                if not announced and self._answers():
                    announced = True
                    ready()
                if not announced:
                    self._check_start(deadline)
                for key, _ in waiting.select(self._pause(announced)):
                    if key.fileobj is self._wake:
                        with suppress(BlockingIOError):
                            self._wake.recv(4096)
                    elif not os.read(key.fd, 4096):
                        return
        finally:
            waiting.close()
            self._end()

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._signals += 1
        if self._signals > 1:
            # A second Ctrl-C: the worker hands its job back without waiting for a checkpoint.
            self.worker.signal(signal.SIGTERM)

    def _tend(self) -> None:
        """Start what is due, and notice what has died."""
        for child in self.children:
            if (how := child.reap()) is not None:
                self.say(
                    f"The {child.name} {how}; starting it anew. Its log: {self.folder.logs / child.name}.log"
                )
            if child.due is not None and child.due <= time.monotonic():
                child.start()

    def _pause(self, announced: bool) -> float | None:
        if not announced:
            return _POLL
        due = [child.due for child in self.children if child.due is not None]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def _check_start(self, deadline: float) -> None:
        for child in self.children:
            if child.deaths >= _GIVE_UP_DEATHS:
                raise UpError(
                    f"The {child.name} does not start. Its last words:\n{self.folder.last_words(child.name)}"
                )
        if time.monotonic() > deadline:
            raise UpError(f"The service did not become ready in {READY_SECONDS:.0f} s: {self._unready()}")

    def _answers(self) -> bool:
        """Whether the API says that it, Redis and the storage are there."""
        return self._ask()[0] == 200

    def _unready(self) -> str:
        _, body = self._ask()
        try:
            checks = json.loads(body)["checks"]
        except (ValueError, KeyError, TypeError):
            return f"the API does not answer.\n{self.folder.last_words('api')}"
        return "; ".join(f"{name}: {said}" for name, said in checks.items() if said != "ok")

    def _ask(self) -> tuple[int, bytes]:
        if not self.api.running:
            return 0, b""
        host, port = self._address
        local = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        connection = http.client.HTTPConnection(local, port, timeout=2)
        try:
            connection.request("GET", "/readyz", headers={"Connection": "close"})
            answer = connection.getresponse()
            return answer.status, answer.read()
        except OSError:
            return 0, b""
        finally:
            connection.close()

    def _end(self) -> None:
        """End every child: the worker saves its job's state first, and Redis, which it says so to, goes last."""
        first = [child for child in self.children if child is not self.redis]
        began = time.monotonic()
        for child in first:
            child.signal(signal.SIGTERM)
        for child in [*first, *([self.redis] if self.redis else [])]:
            if child is self.redis:
                child.signal(signal.SIGTERM)
                began = time.monotonic()
            if not child.wait(child.patience - (time.monotonic() - began)):
                self.say(f"The {child.name} did not end in {child.patience:.0f} s and was killed.")
        signal.set_wakeup_fd(-1)
