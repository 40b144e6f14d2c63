"""One decoding process, as the process that started it sees it."""

from __future__ import annotations

import fcntl
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatmill.schema.files.photos import MAX_PHOTO_PIXELS
from splatmill_worker.errors import Cancelled
from splatmill_worker.images.decoding import messages
from splatmill_worker.images.decoding.decoder import LENGTHS, write_message

MAX_TEXT = 2**20
"""Bytes of an answer besides its arrays."""

MAX_ARRAYS = 4 * MAX_PHOTO_PIXELS
"""Bytes of the arrays of an answer: the largest photo."""

PICTURE_SECONDS = 300.0
"""Time after which decoding one picture is given up. The largest ones take about a minute on a slow core."""

PIPE_BYTES = 2**20
"""Size of the pipe for answers: with Linux's default of 64 KiB, the two processes would take turns a thousand times a
photo."""

POLL_MILLISECONDS = 200
"""Longest wait for bytes of an answer between two checks of the deadline and at `Call.cancelled`."""

_KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "LD_LIBRARY_PATH")
"""Environment variables that a decoding process is given."""

_COMMAND = (sys.executable, "-IB", "-m", "splatmill_worker.images.decoding.decoder")


@dataclass(frozen=True)
class Call:
    """What a decoding process is asked.

    function: called there as function(path, *arguments).
    path: the file that it reads.
    arguments: of JSON values; lists become tuples.
    seconds: time after which the call is given up.
    max_bytes: of the arrays of an answer.
    part: called with each value that the function yields, if it is a generator.
    cancelled: polled while an answer is waited for.
    """

    function: Callable[..., Any]
    path: Path
    arguments: tuple[Any, ...] = ()
    seconds: float = PICTURE_SECONDS
    max_bytes: int = MAX_ARRAYS
    part: Callable[[Any], None] = lambda value: None
    cancelled: Callable[[], bool] = lambda: False

    def text(self) -> bytes:
        """The message that asks it."""
        name = f"{self.function.__module__}:{self.function.__qualname__}"
        call = {"function": name, "path": str(self.path), "arguments": self.arguments}
        return json.dumps(call).encode()


class Ended(Exception):
    """The process ended before it had answered; the message says how."""


class TimeIsUp(Exception):
    """The process did not answer in time, and was ended."""


class DecoderProcess:
    """A process that has been started.

    start: the first message, by which it confines itself.
    lock: a file that it inherits.
    """

    def __init__(self, start: dict[str, Any], lock: int) -> None:
        self._stderr, stderr = os.pipe()
        # What it prints beyond the size of the pipe is lost: nobody reads before it has ended.
        os.set_blocking(stderr, False)
        try:
            self._process = subprocess.Popen(
                _COMMAND,
                env={name: os.environ[name] for name in _KEPT if name in os.environ}
                | {"OMP_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                bufsize=0,
                pass_fds=(lock,),
            )
        except BaseException:
            os.close(self._stderr)
            raise
        finally:
            os.close(stderr)
        assert self._process.stdout is not None
        self._answers = self._process.stdout.fileno()
        self._poll = select.poll()  # `select.select` refuses descriptors from 1024 on
        self._poll.register(self._answers, select.POLLIN)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with suppress(OSError):  # the user has too many large pipes
                fcntl.fcntl(self._answers, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._held: tuple[str, ...] | None = None
        self._send(json.dumps(start).encode())

    def runs(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def ready(self) -> tuple[str, ...]:
        """Wait until it is confined, and return what holds, as `sandbox.confine` does. Raises Ended and TimeIsUp."""
        if self._held is None:
            try:
                answer = self._answer(time.monotonic() + PICTURE_SECONDS, 0, lambda: False)
                self._held = tuple(answer["held"])
            except (ValueError, TypeError, KeyError) as error:
                raise Ended(f"its first answer is not valid, {self.end()}") from error
        return self._held

    def ask(self, call: Call) -> dict[str, Any]:
        """Return the last answer to a call, of which `value` or `error` is an item.

        Raises Ended, TimeIsUp, Cancelled, ValueError for an answer that is not valid, and what `call.part` raises; the
        process can then not be asked again.
        """
        deadline = time.monotonic() + call.seconds
        self._send(call.text())
        while "part" in (answer := self._answer(deadline, call.max_bytes, call.cancelled)):
            call.part(answer["part"])
        if not answer.keys() & {"value", "error"}:
            raise ValueError("the answer has no value")
        return answer

    def end(self, patience: float = 0.0) -> str:
        """End the process, within `patience` seconds if it is ending by itself, and return how it ended."""
        try:
            status = self._process.wait(timeout=patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with suppress(BrokenPipeError):
                stream.close()
        last = self._last_line()
        return f"signal {-status}" if status < 0 else f"exit status {status}{last and f': {last}'}"

    def _send(self, text: bytes) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # there will be no answer, either
            write_message(self._process.stdin, text)

    def _answer(self, deadline: float, max_bytes: int, cancelled: Callable[[], bool]) -> dict[str, Any]:
        try:
            head = self._read(LENGTHS.size, deadline, cancelled)
            text, arrays = LENGTHS.unpack(head.tobytes())
            if text > MAX_TEXT or arrays > max_bytes:
                raise ValueError("the announced answer is too long")
            written = self._read(text, deadline, cancelled).tobytes()
            answer = messages.unpacked(written, self._read(arrays, deadline, cancelled))
        except TimeoutError:
            self.end()
            raise TimeIsUp from None
        except (OSError, EOFError) as error:
            raise Ended(self.end(patience=0.2)) from error
        if not isinstance(answer, dict):
            raise ValueError("the answer is no object")
        return answer

    def _read(self, length: int, deadline: float, cancelled: Callable[[], bool]) -> npt.NDArray[np.uint8]:
        """Read `length` bytes of an answer. Raises EOFError, TimeoutError and Cancelled."""
        # Written before it is read into: page faults within the copy from a pipe take three times as long.
        content = bytearray(length)
        view = memoryview(content)
        while view:
            # Also while bytes arrive: a process that a file has taken over could send some for ever.
            if cancelled():
                raise Cancelled("Reading a file was cancelled.")
            if time.monotonic() > deadline:
                raise TimeoutError
            if not self._poll.poll(POLL_MILLISECONDS):
                continue
            count = os.readv(self._answers, [view])
            if count == 0:
                raise EOFError
            view = view[count:]
        return np.frombuffer(content, np.uint8)

    def _last_line(self) -> str:
        """The last line that it printed, and nothing more; the pipe is closed."""
        if self._stderr < 0:
            return ""
        os.set_blocking(self._stderr, False)
        printed = b""
        with suppress(BlockingIOError):
            while more := os.read(self._stderr, 65536):
                printed += more
        os.close(self._stderr)
        self._stderr = -1
        lines = printed.decode("utf-8", "replace").strip().splitlines()
        return lines[-1][: messages.MAX_REASON] if lines else ""
