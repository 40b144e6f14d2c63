"""The supervisor of the embedded service: starts its processes, restarts them, and stops them in order."""

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
from typing import Any

from splatmill.backplane.private_files import listen
from splatmill_server.up import redis_server
from splatmill_server.up.child import Child
from splatmill_server.up.folder import DataFolder, UpError
from splatmill_server.up.readiness import Readiness

WORKER = "splatmill_worker"

READY_SECONDS = 60.0
"""Time for the service to become ready; a first start may read several hundred megabytes of libraries from disk."""

_STOP_GRACE = 15.0  # seconds for an attempt to write a checkpoint: to this machine, and while somebody waits
_WORKER_STOP_SECONDS = _STOP_GRACE + 5.0
_POLL_SECONDS = 0.02  # between two checks whether the service is ready
_MAX_DEATHS = 5  # of one child before the service is ready


class Supervisor:
    """The processes of one data folder behind one listening socket.

    say: prints messages for the operator.
    renders_late: whether the renderer is started by the first request to it, and not before. A training by one command
        mostly needs none.

    Raises UpError if the worker or Redis is not installed.
    """

    def __init__(
        self,
        folder: DataFolder,
        listener: socket.socket,
        say: Callable[[str], None],
        *,
        renders_late: bool = False,
    ) -> None:
        if importlib.util.find_spec(WORKER) is None:
            raise UpError(
                "The package splatmill-worker, which trains and renders, is not installed: pip "
                "install splatmill-worker."
            )
        self.folder = folder
        self.say = say
        self._readiness = Readiness(listener.getsockname()[:2])
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

        def child(name: str, command: list[str], stop_seconds: float, **more: Any) -> Child:
            return Child(name, command, environment, lambda: folder.log(name), stop_seconds, **more)

        python = sys.executable
        worker = [python, "-m", WORKER, "train", "--stop-grace", str(_STOP_GRACE)]
        self.worker = child("worker", worker, _WORKER_STOP_SECONDS)
        # Started once the API answers: nothing is rendered before, and two cores start three programs more slowly.
        self.renderer = child("renderer", [python, "-m", WORKER, "renderer"], 3.0, due=None)
        self._renders_late = renders_late
        self._views: socket.socket | None = None
        api = [python, "-m", "splatmill_server.up.api", str(listener.fileno())]
        self.api = child("api", api, 6.0, inherited=(listener.fileno(),))
        self.redis: Child | None = None
        if own_redis:
            # On SIGTERM, Redis closes its log and ends. It inherits the lock, so the folder stays locked until then.
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
        """Run the service until a signal arrives or the file descriptor `until_closed` is at its end.

        `ready` is called once the API answers. Returns when all children have ended. Raises UpError if the service does
        not become ready.
        """
        signal.set_wakeup_fd(self._wake_end.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        signal.signal(signal.SIGCHLD, lambda *_: None)  # wakes the loop
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
                    views = self._listen_for_views()
                    if self._renders_late:
                        waiting.register(views, selectors.EVENT_READ)
                    else:
                        self.renderer.due = time.monotonic()
                    ready()
                if not announced:
                    self._check_start(deadline)
                for key, _ in waiting.select(self._pause(announced)):
                    if key.fileobj is self._wake:
                        with suppress(BlockingIOError):
                            self._wake.recv(4096)
                    elif key.fileobj is self._views:
                        waiting.unregister(self._views)
                        self.renderer.due = time.monotonic()
                    elif not os.read(key.fd, 4096):
                        self._signals += 1  # counts as the first request to stop
                        return
        finally:
            waiting.close()
            self._readiness.close()
            self._stop()

    def _listen_for_views(self) -> socket.socket:
        """Open the socket of the renderer, which each of its processes inherits: requests wait while one starts."""
        try:
            self._views = listen(self.folder.renderer_socket, "choose another folder with --data.")
            self._views.listen(128)
        except OSError as error:
            raise UpError(str(error)) from error
        number = self._views.fileno()
        self.renderer.command = [*self.renderer.command, "--fd", str(number)]
        self.renderer.inherited = (number,)
        return self._views

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._signals += 1
        if self._signals > 1:
            # At a second Ctrl-C, the worker hands its job back without writing a checkpoint.
            self.worker.signal(signal.SIGTERM)

    def _tend(self) -> None:
        """Start the children that are due, and report those that have died."""
        for child in self.children:
            if (how := child.reap()) is not None:
                self.say(
                    f"The {child.name} {how} and will be restarted. Its log: "
                    f"{self.folder.logs / child.name}.log"
                )
            if child.due is not None and child.due <= time.monotonic():
                child.start()

    def _pause(self, announced: bool) -> float | None:
        if not announced:
            return _POLL_SECONDS
        due = [child.due for child in self.children if child.due is not None]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def _check_start(self, deadline: float) -> None:
        for child in self.children:
            if child.deaths >= _MAX_DEATHS:
                raise UpError(
                    f"The {child.name} does not start. The end of its log:\n{self.folder.log_end(child.name)}"
                )
        if time.monotonic() > deadline:
            raise UpError(f"The service was not ready after {READY_SECONDS:.0f} s: {self._unready()}")

    def _answers(self) -> bool:
        """Return whether the API reports that Redis and storage are available."""
        return self.api.running and self._readiness.ask()[0] == 200

    def _unready(self) -> str:
        _, body = self._readiness.ask()
        try:
            checks = json.loads(body)["checks"]
        except (ValueError, KeyError, TypeError):
            return f"the API does not answer. The end of its log:\n{self.folder.log_end('api')}"
        wrong = "; ".join(f"{name}: {state}" for name, state in checks.items() if state != "ok")
        return f"{wrong}\nThe end of the log of the API:\n{self.folder.log_end('api')}"

    def _stop(self) -> None:
        """Stop all children. Redis is stopped last, because the worker needs it to hand its job back."""
        first = [child for child in self.children if child is not self.redis]
        began = time.monotonic()
        for child in first:
            child.signal(signal.SIGTERM)
        for child in [*first, *([self.redis] if self.redis else [])]:
            if child is self.redis:
                child.signal(signal.SIGTERM)
                began = time.monotonic()
            if not child.wait(child.stop_seconds - (time.monotonic() - began)):
                self.say(f"The {child.name} did not end within {child.stop_seconds:.0f} s and was killed.")
        if self._views is not None:
            self._views.close()
            self.folder.renderer_socket.unlink(missing_ok=True)
        signal.set_wakeup_fd(-1)
