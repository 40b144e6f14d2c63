"""Decodes pictures and videos in processes of their own while an attempt runs, and in this process otherwise.

What reads strangers' files is the part that such a file may take over. Within `confined`, that part runs in processes
without secrets, network, or files but those of the job (see `decoder` and `sandbox`), and one that crashes costs one
photo. Programs on a user's own files (`fit-image`, the engine as a library) decode in their own process.
"""

from __future__ import annotations

import json
import os
import queue
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from PIL import Image
from pydantic import TypeAdapter

from splatmill.schema.photos import MAX_PHOTO_PIXELS
from splatmill_worker.errors import Cancelled, UnusablePicture, UnusableVideo
from splatmill_worker.images import decode as decode_here
from splatmill_worker.images import examine as examine_here
from splatmill_worker.images import guarded, masks, video
from splatmill_worker.images.decoder import LENGTHS, write_message
from splatmill_worker.images.examine import Picture

PROCESSES = min(os.cpu_count() or 1, 8)
"""Decoding processes of an attempt."""

MEMORY = 16 * MAX_PHOTO_PIXELS + 2 * 2**30
"""Bytes of address space of a decoding process: the largest photo, a few copies of it, and the libraries."""

PICTURE_SECONDS = 300.0
"""Time after which decoding one picture is given up. The largest ones take about a minute on a slow core."""

MAX_TEXT = 2**20
"""Bytes of an answer besides its pixels."""

PIPE_BYTES = 2**20
"""Size of the pipes: with Linux's default of 64 KiB, the two processes would take turns a thousand times a photo."""

_KEPT = ("PATH", "LANG", "LC_ALL", "TZ", "LD_LIBRARY_PATH")
"""Environment variables that a decoding process is given."""

_BYTES = {"L": 1, "RGB": 3, "RGBA": 4}

Answer = tuple[dict[str, Any], bytearray]
"""What a process answers, and pixels."""

# What a process answers is checked, since a file may have taken the process over.
_SIZES: TypeAdapter[tuple[tuple[int, int], tuple[int, int]]] = TypeAdapter(
    tuple[tuple[int, int], tuple[int, int]]
)
_PICTURE = TypeAdapter(Picture)
_FAULT: TypeAdapter[str | None] = TypeAdapter(str | None)

_active: Decoders | None = None


@contextmanager
def confined(read: list[Path], write: list[Path]) -> Iterator[Decoders]:
    """Let decoding processes open the files of strangers within the block.

    read, write: the files and folders that they may open.
    """
    global _active
    decoders = Decoders(read, write)
    _active = decoders
    try:
        yield decoders
    finally:
        _active = None
        decoders.close()


def decode(path: Path, *, at_least: tuple[int, int] | None = None, upright: bool = True) -> Image.Image:
    """Like `splatmill_worker.images.decode.decode`."""
    if _active is None:
        return decode_here.decode(path, at_least=at_least, upright=upright)
    answer, pixels = _active.call(
        path, "decode", {"path": str(path), "at_least": at_least, "upright": upright}
    )
    mode, (width, height) = answer["mode"], answer["size"]
    if mode not in _BYTES or len(pixels) != width * height * _BYTES[mode]:
        raise UnusablePicture("image_truncated", path.name, "its decoder gave an answer of another size")
    return Image.frombuffer(mode, (width, height), pixels, "raw", mode, 0, 1)


def sizes(path: Path, name: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Like `splatmill_worker.images.decode.sizes`."""
    if _active is None:
        return decode_here.sizes(path, name)
    answer, _ = _active.call(path, "sizes", {"path": str(path), "name": name})
    return _SIZES.validate_python(answer["sizes"])


def examine(path: Path, name: str) -> Picture | str:
    """Like `splatmill_worker.images.examine.examine`."""
    if _active is None:
        return examine_here.examine(path, name)
    try:
        answer, _ = _active.call(path, "examine", {"path": str(path), "name": name})
    except UnusablePicture as error:
        return error.reason
    if "reason" in answer:
        return str(answer["reason"])
    return _PICTURE.validate_python(answer["picture"])


def mask_fault(mask: Path, photo: tuple[int, int], *, upright: bool = True) -> str | None:
    """Like `splatmill_worker.images.masks.mask_fault`."""
    if _active is None:
        return masks.mask_fault(mask, photo, upright=upright)
    answer, _ = _active.call(mask, "mask_fault", {"mask": str(mask), "photo": photo, "upright": upright})
    return _FAULT.validate_python(answer["fault"])


def keyframes(
    path: Path, target: Path, count: int, *, cancelled: Callable[[], bool] = lambda: False
) -> list[Path]:
    """Like `splatmill_worker.images.video.keyframes`."""
    if _active is None:
        return video.keyframes(path, target, count, cancelled=cancelled)
    target.mkdir(parents=True, exist_ok=True)
    given = {"path": str(path), "target": str(target), "count": count}
    answer, _ = _active.call(path, "keyframes", given, 2 * guarded.MAX_READING_SECONDS, cancelled)
    return [target / Path(str(name)).name for name in answer["names"]]


class Decoders:
    """Decoding processes: one from the beginning, others when all are busy.

    held: what confines them, as `sandbox.confine` returns it; None before the first answer.
    """

    def __init__(self, read: list[Path], write: list[Path], processes: int = PROCESSES) -> None:
        self.held: tuple[str, ...] | None = None
        self._room = tempfile.TemporaryFile()  # noqa: SIM115  # closed by `close`
        self._start = {
            "read": [str(path) for path in read],
            "write": [str(path) for path in write],
            "memory": MEMORY,
            "pixels": guarded.decoding_pixels() // processes,
            "room": self._room.fileno(),
        }
        self._free: queue.LifoQueue[_Process | None] = queue.LifoQueue()
        for _ in range(processes - 1):
            self._free.put(None)
        self._free.put(_Process(self._start, self._room.fileno()))
        self._processes = processes

    def call(
        self,
        path: Path,
        name: str,
        arguments: dict[str, Any],
        seconds: float = PICTURE_SECONDS,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Answer:
        """Let a process answer a call about the file `path`; wait for a process if all are busy.

        Raises what the call raised, UnusablePicture or UnusableVideo when the process died of the file or took longer
        than `seconds`, and Cancelled.
        """
        process = self._free.get()
        try:
            process = process or _Process(self._start, self._room.fileno())
            self.held = process.ready()
            answer = process.ask({"name": name, "arguments": arguments}, seconds, cancelled)
        except _Died as error:
            process = None
            kind = UnusableVideo if name == "keyframes" else _unusable_picture
            raise kind(path.name, str(error)) from error
        except BaseException:
            if process is not None:
                process.kill()
                process = None
            raise
        finally:
            self._free.put(process)
        _raise_described(answer[0].get("error"), path)
        return answer

    def ready(self) -> tuple[str, ...]:
        """Wait until a process is confined, and return what holds. Raises RuntimeError if it does not start."""
        process = self._free.get() or _Process(self._start, self._room.fileno())
        self._free.put(process)
        return process.ready()

    def close(self) -> None:
        """End the processes. No call may be under way."""
        for _ in range(self._processes):
            process = self._free.get()
            if process is not None:
                process.kill()
        self._room.close()


class _Died(Exception):
    """A decoding process ended or was ended; the message is a part of a sentence about its file."""


class _Process:
    def __init__(self, start: dict[str, Any], inherited: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-m", "splatmill_worker.images.decoder"],
            env={name: os.environ[name] for name in _KEPT if name in os.environ} | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            pipesize=PIPE_BYTES,
            pass_fds=(inherited,),
        )
        self._held: tuple[str, ...] | None = None
        self._send(start)

    def ready(self) -> tuple[str, ...]:
        """Wait until the process is confined, and return what holds. Raises RuntimeError if it does not start."""
        if self._held is None:
            try:
                answer, _ = self._answer(PICTURE_SECONDS, lambda: False)
            except _Died as error:
                raise RuntimeError(f"A process that decodes photos could not be started: {error}.") from error
            self._held = tuple(answer["held"])
        return self._held

    def ask(self, message: dict[str, Any], seconds: float, cancelled: Callable[[], bool]) -> Answer:
        """Send a message and return the answer. Raises _Died when there is none in time, and Cancelled."""
        self._send(message)
        return self._answer(seconds, cancelled)

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # there will be no answer, either
            write_message(self._process.stdin, message)

    def _answer(self, seconds: float, cancelled: Callable[[], bool]) -> Answer:
        deadline = time.monotonic() + seconds
        try:
            text, pixels = LENGTHS.unpack(self._read(LENGTHS.size, deadline, cancelled))
            if text > MAX_TEXT or pixels > 4 * MAX_PHOTO_PIXELS:
                raise ValueError("the announced answer is too long")
            return json.loads(self._read(text, deadline, cancelled)), self._read(pixels, deadline, cancelled)
        except TimeoutError:
            self.kill()
            raise _Died(f"decoding it took longer than {seconds:.0f} seconds") from None
        except (OSError, EOFError, ValueError) as error:
            raise _Died(f"its decoder ended unexpectedly ({_said(self.kill())})") from error

    def _read(self, length: int, deadline: float, cancelled: Callable[[], bool]) -> bytearray:
        """Read `length` bytes of an answer. Raises EOFError, TimeoutError and Cancelled."""
        assert self._process.stdout is not None
        content = bytearray(length)
        view, source = memoryview(content), self._process.stdout.fileno()
        while view:
            if not select.select([source], [], [], 0.2)[0]:
                if cancelled():
                    raise Cancelled("Reading the video was cancelled.")
                if time.monotonic() > deadline:
                    raise TimeoutError
                continue
            got = os.readv(source, [view])
            if got == 0:
                raise EOFError
            view = view[got:]
        return content

    def kill(self) -> int:
        """End the process and return its exit status."""
        try:
            status = self._process.wait(timeout=0.2)  # it may be ending by itself, for a reason
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with suppress(BrokenPipeError):
                stream.close()
        return status


def _said(status: int) -> str:
    return f"signal {-status}" if status < 0 else f"exit status {status}"


def _unusable_picture(name: str, reason: str) -> UnusablePicture:
    return UnusablePicture("image_truncated", name, reason)


def _raise_described(error: dict[str, Any] | None, path: Path) -> None:
    """Raise the error that a decoding process described."""
    if error is None:
        return
    if error["kind"] == "picture":
        raise UnusablePicture(error["code"], error["name"], error["reason"])
    if error["kind"] == "video":
        raise UnusableVideo(error["name"], error["reason"])
    if error["kind"] == "system":
        raise OSError(error["errno"], error["text"], error["path"])
    if error["kind"] == "memory":
        limit = f"{MEMORY / 2**30:.0f} GiB"
        raise UnusablePicture("image_too_large", path.name, f"decoding it takes more than {limit} of memory")
    raise UnusablePicture("image_truncated", path.name, f"it does not decode: {error['text']}")
