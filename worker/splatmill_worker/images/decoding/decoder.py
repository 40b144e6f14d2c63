"""The process that reads strangers' files: `python -IB -m splatmill_worker.images.decoding.decoder`.

It confines itself before it reads the first byte of a file, and then answers the calls of `decoders`, one after the
other, on standard input and output. It has no secrets, no network, no file to write, and only the folders that it was
given to read.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import signal
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from splatmill_worker.sandbox import confine

LENGTHS = struct.Struct("=QQ")
"""Before each message: the bytes of its JSON text, and of the arrays behind it."""

_SYSTEM = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/dev/null", "/dev/urandom", "/proc/cpuinfo")
"""Files and folders of the system that libraries read; the last one by PyTorch."""

PACKAGE = "splatmill_worker."
"""Beginning of the modules whose functions are called."""


def write_message(stream: IO[bytes], text: bytes, arrays: Sequence[memoryview] = ()) -> None:
    stream.write(LENGTHS.pack(len(text), sum(array.nbytes for array in arrays)))
    stream.write(text)
    for array in arrays:
        stream.write(array)
    stream.flush()


def main() -> None:
    """Answer calls until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries may print; only answers may reach the caller.
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    first = _read_call(calls)
    if first is None:
        return
    held = confine([*map(Path, first["read"]), *program_files()], int(first["memory"]))
    # Imported after that: their libraries start threads, and confinement must come before these.
    from splatmill_worker.images import guarded
    from splatmill_worker.images.decoding import messages
    from splatmill_worker.readers import reader_memory

    reader_memory.set_limit(int(first["limit"]))
    guarded.share_room(int(first["pixels"]), int(first["room"]))
    write_message(answers, *messages.packed({"held": held}))
    while (call := _read_call(calls)) is not None:
        try:
            _answer(call, answers)
        except BrokenPipeError:
            return  # the caller has ended


def program_files() -> list[Path]:
    """Return what the interpreter and its modules are read from."""
    specs = [importlib.util.find_spec(name) for name in ("splatmill", "splatmill_worker")]
    modules = [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]
    system = [Path(place) for place in _SYSTEM]
    imported = [Path(place) for place in sys.path if os.path.isdir(place)]
    linked = [entry.resolve() for place in imported for entry in place.iterdir() if entry.is_symlink()]
    return [*modules, *imported, *linked, Path(sys.prefix), Path(sys.base_prefix), *system]


def _read_call(stream: IO[bytes]) -> dict[str, Any] | None:
    """Return the next message, which has no arrays; None at the end of the stream."""
    head = stream.read(LENGTHS.size)
    if len(head) < LENGTHS.size:
        return None
    text: dict[str, Any] = json.loads(stream.read(LENGTHS.unpack(head)[0]))
    return text


def _answer(call: dict[str, Any], answers: IO[bytes]) -> None:
    """Write the answers to a call. None of their arrays is left in memory while the next call is waited for."""
    from splatmill_worker.images.decoding import messages

    try:
        for answer in _answered(call):
            write_message(answers, *messages.packed(answer))
    except BrokenPipeError:
        raise
    except Exception as error:  # the caller raises it again
        write_message(answers, *messages.packed({"error": messages.described(error)}))


def _answered(call: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Call the function, and yield its result; of a generator, each part, and then an answer without a value."""
    arguments = [tuple(value) if isinstance(value, list) else value for value in call["arguments"]]
    result = _function(call["function"])(Path(call["path"]), *arguments)
    if not isinstance(result, Iterator):
        yield {"value": result}
        return
    for part in result:
        yield {"part": part}
    yield {"value": None}


def _function(name: str) -> Callable[..., Any]:
    module, _, own = name.partition(":")
    if not module.startswith(PACKAGE):
        raise ValueError(f"{name} is no function of this package.")
    function: Callable[..., Any] = getattr(importlib.import_module(module), own)
    return function


if __name__ == "__main__":
    main()
