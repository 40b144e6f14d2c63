"""Reads strangers' files in processes of their own while an attempt runs, and in this process otherwise.

A damaged file may crash the library that reads it, and a hostile one may run code there. Within `confined`, files are
therefore read in processes without secrets, network, files to write, or files to read but those of the job (see
`decoder` and `sandbox`). If a process ends, another one reads the file again; a file that ends two is not read.
Programs on a user's own files (`fit-image`, the engine as a library) read in their own process.

`call` runs any function of this package there: what `decode` and the others below do for pictures.
"""

from __future__ import annotations

import logging
import os
import queue
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

from PIL import Image
from pydantic import Field, TypeAdapter

from splatmill.schema import format_bytes
from splatmill.schema.files.photos import MAX_PHOTO_PIXELS
from splatmill_worker import memory, settings
from splatmill_worker.errors import DecoderNotStarted, UnusablePicture, UnusableVideo
from splatmill_worker.images import decode as decode_here
from splatmill_worker.images import examine as examine_here
from splatmill_worker.images import guarded, masks, transparency
from splatmill_worker.images.decoding import messages
from splatmill_worker.images.decoding.decoder_process import (
    MAX_ARRAYS,
    PICTURE_SECONDS,
    Call,
    DecoderProcess,
    Ended,
    TimeIsUp,
)
from splatmill_worker.images.decoding.ended_files import EndedFiles
from splatmill_worker.images.decoding.turns import Turns
from splatmill_worker.images.examine import Picture
from splatmill_worker.images.video import video
from splatmill_worker.readers import reader_memory

PROCESSES = min(os.cpu_count() or 1, 8)
"""Decoding processes of an attempt."""

STARTS = 10
"""Processes that are started for one call, if each ends before it has begun."""

LIBRARIES = 2 * 2**30
"""Bytes of address space of a decoding process without a photo."""

READING_SECONDS = 300.0
"""Time after which reading a model, or a file of cameras or points, is given up."""

ANSWER_SHARE = 4
"""The memory that reading a model may take, over that of its answer, at least. Readers take more than five times the
memory of the arrays that they return."""

OWN_MEMORY = 2**30
"""Bytes of address space that a process needs to read models, besides the files of its libraries."""

_LACKING = {
    "files": "they can read other files",
    "calls": "they can use the network, start programs and change files",
    "memory": "their memory is not limited",
}
"""What a decoding process can do without each of what `sandbox.confine` returns."""

Fault = Callable[[str, str, str], Exception]
"""Makes the error of a file that cannot be read, of a code, its name, and a reason as a part of a sentence. Codes:
image_truncated (also of other files that are damaged), image_too_large, and decoder_ended. An error with the last code
lets the job be tried again."""

T = TypeVar("T")

INVALID = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError)
"""What the check of an answer may raise."""

# What a process answers is checked, since a file may have taken the process over.
_Size = tuple[int, int]
_SIZES: TypeAdapter[tuple[_Size, _Size, int]] = TypeAdapter(tuple[_Size, _Size, int])
_PICTURE: TypeAdapter[Picture | str] = TypeAdapter(Picture | str)
_FAULT: TypeAdapter[str | None] = TypeAdapter(str | None)
_TEXT: TypeAdapter[str] = TypeAdapter(str)
_EXTENT: TypeAdapter[transparency.Extent] = TypeAdapter(transparency.Extent)
_REMARKS: TypeAdapter[list[str]] = TypeAdapter(list[str])
_LEVELS = TypeAdapter(Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=256, max_length=256)])

log = logging.getLogger("splatmill.decoders")

_active: Decoders | None = None


@contextmanager
def confined(
    read: list[Path],
    ended: Path | None = None,
    cancelled: Callable[[], bool] = lambda: False,
    *,
    keep_reader: bool = False,
) -> Iterator[Decoders]:
    """Let decoding processes open the files of strangers within the block.

    read: the files and folders that they may open.
    ended: a file with the list of files that have ended their process twice, which the next attempt does not open.
    cancelled: whether the reader of a model (`call_once`), which takes minutes for some, is to end.
    keep_reader: let one process answer all of `call_once`, one at a time, within what was free at the first of them.
        For benchmarks and tests that read thousands of models: the start of a process takes seconds.
    """
    global _active
    decoders = Decoders(read, ended, cancelled=cancelled, keep_reader=keep_reader)
    _active = decoders
    try:
        yield decoders
    finally:
        _active = None
        decoders.close()


def call(
    function: Callable[..., Any],
    path: Path,
    *arguments: Any,
    check: Callable[[Any], T],
    fault: Fault = UnusablePicture,
    seconds: float = PICTURE_SECONDS,
    max_bytes: int = MAX_ARRAYS,
) -> T:
    """Return check(function(path, *arguments)), with the function called in a decoding process.

    function: of a module of this package, not nested. It returns dicts, lists, tuples, dataclasses, str, numbers, None,
        bytes and NumPy arrays; tuples arrive as lists, and dataclasses as dicts.
    arguments: None, str, numbers, and tuples of these.
    check: makes the value to return of what arrives, and raises one of INVALID for what the function never returns.
    fault: makes the error that is raised where the process ended twice or took longer than `seconds`, and where
        its answer is not valid.
    max_bytes: of the arrays of an answer.

    Raises what the function raises: the errors of `messages`, OSError and ValueError. Others become a `fault`.
    """
    if _active is None:
        return check(function(path, *arguments))
    return _active.call(Call(function, path, arguments, seconds, max_bytes), check, fault)


def call_once(
    function: Callable[..., Any],
    path: Path,
    *arguments: Any,
    check: Callable[[Any], T],
    fault: Fault,
) -> T:
    """Like `call`, in a process that ends with the call, since the libraries that read models are large
    (unless `confined` keeps it).

    It may take all the memory that is free (`reader_memory.limit`). Its answer may take a part of that, which this
    process allocates as soon as the length is announced. Raises Cancelled as well, within a fraction of a second.
    """
    if _active is None:
        return check(function(path, *arguments))
    with _active.reader() as own:
        most = own.limit // ANSWER_SHARE
        asked = Call(function, path, arguments, READING_SECONDS, most, cancelled=_active.cancelled)
        return own.call(asked, check, fault)


def decode(path: Path, *, at_least: tuple[int, int] | None = None, upright: bool = True) -> Image.Image:
    """Like `splatmill_worker.images.decode.decode`."""
    if _active is None:
        return decode_here.decode(path, at_least=at_least, upright=upright)
    return call(decode_here.pixels, path, at_least, upright, check=decode_here.picture_of)


def sizes(path: Path, name: str) -> tuple[tuple[int, int], tuple[int, int], int]:
    """Like `splatmill_worker.images.decode.sizes`."""
    return call(decode_here.sizes, path, name, check=_SIZES.validate_python)


def photo_colors(path: Path, name: str) -> str:
    """Like `splatmill_worker.images.decode.colors`."""
    return call(decode_here.colors, path, name, check=_TEXT.validate_python)


def alpha(path: Path) -> transparency.Extent:
    """Like `splatmill_worker.images.decode.alpha`."""
    return call(decode_here.alpha, path, check=_EXTENT.validate_python)


def examine(path: Path, name: str) -> Picture | str:
    """Like `splatmill_worker.images.examine.examine`."""
    try:
        return call(examine_here.examine, path, name, check=_PICTURE.validate_python)
    except UnusablePicture as error:
        return error.reason


def mask_fault(mask: Path, photo: tuple[int, int], *, upright: bool = True) -> str | None:
    """Like `splatmill_worker.images.masks.mask_fault`."""
    return call(masks.mask_fault, mask, photo, upright, check=_FAULT.validate_python)


def mask_levels(mask: Path) -> list[int]:
    """Like `splatmill_worker.images.masks.levels`."""
    return call(masks.levels, mask, check=_LEVELS.validate_python)


def keyframes(
    path: Path, target: Path, count: int, *, cancelled: Callable[[], bool] = lambda: False
) -> list[Path]:
    """Write at most `count` frames of the video at `path` as JPEGs in `target`, and return their paths in order.

    The files are called <stem>_<frame number>.jpg. The frames are those of `images.video.video.keyframes`,
    which raises the same errors.
    """
    target.mkdir(parents=True, exist_ok=True)
    written: dict[int, Path] = {}

    def write(number: int, picture: bytes) -> None:
        written[number] = target / f"{path.stem}_{number:06d}.jpg"
        written[number].write_bytes(picture)

    if _active is None:
        for frame in video.keyframes(path, count, cancelled):
            write(*frame)
    else:
        _active.keyframes(path, count, write, cancelled)
    return [written[number] for number in sorted(written)]


def video_remarks(path: Path) -> list[str]:
    """Like `splatmill_worker.images.video.video.remarks`."""
    return call(
        video.remarks,
        path,
        check=_REMARKS.validate_python,
        fault=lambda code, name, reason: UnusableVideo(name, reason),
    )


def ended(path: Path) -> str | None:
    """Why a file is not opened again, as a part of a sentence; None for one that has not ended its process twice."""
    return None if _active is None else _active.ended(path)


def forget_ended() -> bool:
    """Let the files that ended their process twice be tried again. Return whether there were any."""
    return _active is not None and _active.forget_ended()


class Decoders:
    """Decoding processes: one from the beginning, others when all are busy.

    held: what confines them, as `sandbox.confine` returns it; None before the first answer.
    read: the files and folders that they may open.
    cancelled, keep_reader: of `confined`.
    limit, libraries: bytes of address space of each for what it reads, by default `memory_limit()`, and besides that.
    """

    def __init__(
        self,
        read: list[Path],
        ended: Path | None = None,
        processes: int = PROCESSES,
        *,
        limit: int | None = None,
        libraries: int = LIBRARIES,
        cancelled: Callable[[], bool] = lambda: False,
        keep_reader: bool = False,
    ) -> None:
        self.read = read
        self.cancelled = cancelled
        self.held: tuple[str, ...] | None = None
        self._room = tempfile.TemporaryFile()  # noqa: SIM115  # closed by `close`
        self._root = read[0] if read else Path("/")
        self._ended = EndedFiles(ended)
        self.limit = limit = memory_limit() if limit is None else limit
        self._memory = limit + libraries
        self._keep_reader = keep_reader
        self._reader: Decoders | None = None
        self._start = {
            "read": [str(path) for path in read],
            "memory": self._memory,
            "limit": limit,
            "pixels": guarded.decoding_pixels(settings.max_memory()) // processes,
            "room": self._room.fileno(),
        }
        self._turns = Turns()
        self._processes = processes
        self._free: queue.LifoQueue[DecoderProcess | None] = queue.LifoQueue()
        for _ in range(processes - 1):
            self._free.put(None)
        first = None
        with suppress(OSError):  # the first call tries again
            first = DecoderProcess(self._start, self._room.fileno())
        self._free.put(first)

    def call(self, call: Call, check: Callable[[Any], T], fault: Fault) -> T:
        """Let a process answer a call; wait for a process if all are busy. See `decoders.call`.

        Raises DecoderNotStarted, and Cancelled.
        """
        name = call.path.name
        if (reason := self.ended(call.path)) is not None:
            raise fault("decoder_ended", name, reason)
        how = ""
        for alone in (False, True):
            try:
                with self._turns.taken(alone=alone):
                    answer = self._answer(call, check, fault)
                if isinstance(answer, Exception):
                    raise answer
                return answer
            except Ended as error:
                how = str(error)
            except TimeIsUp:
                reason = f"decoding it took longer than {call.seconds:.0f} seconds"
                raise fault("image_truncated", name, reason) from None
        reason = f"it could not be decoded: its decoder was ended twice ({how})"
        self._ended.add(self._key(call.path), reason)
        raise fault("decoder_ended", name, reason)

    def keyframes(
        self, path: Path, count: int, write: Callable[[int, bytes], None], cancelled: Callable[[], bool]
    ) -> None:
        """Call `write` with the number and the JPEG of each frame of `video.keyframes`; from the first one again if a
        process ends. Raises UnusableVideo and Cancelled."""
        sizes = dict[int, int]()

        def part(value: Any) -> None:
            number, picture = value
            if type(number) is not int or type(picture) is not bytes or number < 0:
                raise ValueError("a frame is a number and its JPEG")
            sizes[number] = len(picture)
            if len(sizes) > count or sum(sizes.values()) > video.MAX_WRITTEN_BYTES:
                raise ValueError("there are more or larger frames than were asked for")
            write(number, picture)

        seconds = 2 * guarded.MAX_READING_SECONDS
        call = Call(video.keyframes, path, (count,), seconds, MAX_ARRAYS, part, cancelled)
        self.call(call, lambda value: None, lambda code, name, reason: UnusableVideo(name, reason))

    @contextmanager
    def reader(self) -> Iterator[Decoders]:
        """One process that may take all the memory that is free, for a call; see `call_once`."""
        own = self._reader
        if own is None:
            limit = reader_memory.limit()
            own = Decoders(self.read, processes=1, limit=limit, libraries=OWN_MEMORY + memory.mapped_files())
        self._reader = own if self._keep_reader else None
        try:
            yield own
        finally:
            own.forget_ended()  # a kept one may be given another file under the same name
            if not self._keep_reader:
                own.close()

    def ready(self) -> tuple[str, ...]:
        """Wait until a process is confined, and return what holds. Raises DecoderNotStarted."""
        process = None
        slot = self._free.get()
        try:
            process = self._started(slot)
        finally:
            self._free.put(process)
        return process.ready()

    def lacking(self) -> str:
        """What does not confine the processes here, as a part of a sentence; "" if all does."""
        return _lacking(self.ready())

    def ended(self, path: Path) -> str | None:
        """See `decoders.ended`."""
        return self._ended.reason(self._key(path))

    def forget_ended(self) -> bool:
        """See `decoders.forget_ended`."""
        return self._ended.forget()

    def close(self) -> None:
        """End the processes. No call may be under way."""
        if self._reader is not None:
            self._reader.close()
        for _ in range(self._processes):
            process = self._free.get()
            if process is not None:
                process.end()
        self._room.close()

    def _key(self, path: Path) -> str:
        return os.path.relpath(path, self._root)

    def _answer(self, call: Call, check: Callable[[Any], T], fault: Fault) -> T | Exception:
        """What `check` makes of the answer of a process, or the error that it describes.

        The process is kept for other calls, unless it ended, or its answer is not valid: a file may have taken it over.
        """
        slot, kept = self._free.get(), None
        try:
            process = self._started(slot)
            try:
                answer = process.ask(call)
                if "error" in answer:
                    result: T | Exception = self._error(answer["error"], call.path.name, fault)
                else:
                    result = check(answer["value"])
            except BaseException as error:
                process.end()
                if isinstance(error, INVALID):
                    reason = "its decoder gave an answer that is not valid"
                    raise fault("image_truncated", call.path.name, reason) from error
                raise
            kept = process
            return result
        finally:
            self._free.put(kept)

    def _started(self, process: DecoderProcess | None) -> DecoderProcess:
        """A process that waits for a call: `process`, or a new one where it has ended meanwhile."""
        how = ""
        for _ in range(STARTS):
            try:
                if process is None or not process.runs():
                    if process is not None:
                        process.end()
                    process = DecoderProcess(self._start, self._room.fileno())
                held = process.ready()
                if self.held is None and (lacking := _lacking(held)):
                    log.warning("Photos are decoded in processes without secrets, but %s.", lacking)
                self.held = held
                return process
            except (Ended, OSError) as error:
                how = str(error)
            except TimeIsUp:
                how = f"it was not ready after {PICTURE_SECONDS:.0f} seconds"
                break
            process = None
        raise DecoderNotStarted(how)

    def _error(self, description: Any, name: str, fault: Fault) -> Exception:
        """The error that a process described. Raises ValueError for anything but a description."""
        error = messages.error_of(description, lambda reason: fault("image_truncated", name, reason))
        if isinstance(error, MemoryError):
            limit = format_bytes(self._memory)
            error = fault("image_too_large", name, f"decoding it takes more than {limit} of memory")
        return error


def _lacking(held: tuple[str, ...]) -> str:
    return " and ".join(words for name, words in _LACKING.items() if name not in held)


def memory_limit() -> int:
    """Bytes of address space of a decoding process besides its libraries: the largest photo and a few copies of it, or
    what the machine or the attempt has if that is less."""
    machine = guarded.machine_bytes()
    return min(16 * MAX_PHOTO_PIXELS, machine, settings.max_memory() or machine)
