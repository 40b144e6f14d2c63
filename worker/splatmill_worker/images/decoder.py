"""The process that decodes strangers' pictures and videos: `python -I -m splatmill_worker.images.decoder`.

It confines itself before it reads the first byte of a file, and then answers the calls of `decoders`, one after the
other, on standard input and output. It has no secrets, no network, and only the folders that it was given.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import struct
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from splatmill_worker.sandbox import confine

LENGTHS = struct.Struct("=QQ")
"""Before each message: the bytes of its JSON text, and of the pixels behind it."""

Answer = tuple[dict[str, Any], bytes]


def read_message(stream: IO[bytes]) -> Answer | None:
    """Return the next message and its pixels, or None at the end of the stream."""
    head = stream.read(LENGTHS.size)
    if len(head) < LENGTHS.size:
        return None
    text, pixels = LENGTHS.unpack(head)
    return json.loads(stream.read(text)), stream.read(pixels)


def write_message(stream: IO[bytes], message: dict[str, Any], pixels: bytes = b"") -> None:
    text = json.dumps(message).encode()
    stream.write(LENGTHS.pack(len(text), len(pixels)))
    stream.write(text)
    stream.write(pixels)
    stream.flush()


def main() -> None:
    """Answer calls until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries may print; only answers may reach the caller.
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    first = read_message(calls)
    if first is None:
        return
    given = first[0]
    held = confine(
        [*map(Path, given["read"]), *program_files()], map(Path, given["write"]), int(given["memory"])
    )
    from splatmill_worker.images import guarded

    guarded.share_room(int(given["pixels"]), int(given["room"]))
    answered = _answers()
    write_message(answers, {"held": held})
    while (message := read_message(calls)) is not None:
        call = message[0]
        try:
            result, pixels = answered[call["name"]](call["arguments"])
        except Exception as error:  # the caller raises it again
            result, pixels = {"error": _described(error)}, b""
        write_message(answers, result, pixels)


def program_files() -> list[Path]:
    """Return what the interpreter and its modules are read from."""
    found = [importlib.util.find_spec(name) for name in ("splatmill", "splatmill_worker")]
    modules = [Path(place) for spec in found if spec for place in spec.submodule_search_locations or ()]
    system = [
        Path(place) for place in ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/dev/null", "/dev/urandom")
    ]
    imported = [Path(place) for place in sys.path if os.path.isdir(place)]
    linked = [entry.resolve() for place in imported for entry in place.iterdir() if entry.is_symlink()]
    return [*modules, *imported, *linked, Path(sys.prefix), Path(sys.base_prefix), *system]


def _answers() -> dict[str, Callable[[dict[str, Any]], Answer]]:
    from splatmill_worker.images.decode import decode, sizes
    from splatmill_worker.images.examine import examine
    from splatmill_worker.images.masks import mask_fault
    from splatmill_worker.images.video import keyframes

    def decoded(given: dict[str, Any]) -> Answer:
        least = given["at_least"]
        image = decode(
            Path(given["path"]), at_least=tuple(least) if least else None, upright=given["upright"]
        )
        return {"mode": image.mode, "size": image.size}, image.tobytes()

    def sized(given: dict[str, Any]) -> Answer:
        return {"sizes": sizes(Path(given["path"]), given["name"])}, b""

    def examined(given: dict[str, Any]) -> Answer:
        found = examine(Path(given["path"]), given["name"])
        return {"reason": found} if isinstance(found, str) else {"picture": asdict(found)}, b""

    def fault(given: dict[str, Any]) -> Answer:
        return {
            "fault": mask_fault(Path(given["mask"]), tuple(given["photo"]), upright=given["upright"])
        }, b""

    def frames(given: dict[str, Any]) -> Answer:
        written = keyframes(Path(given["path"]), Path(given["target"]), given["count"])
        return {"names": [path.name for path in written]}, b""

    return {
        "decode": decoded,
        "sizes": sized,
        "examine": examined,
        "mask_fault": fault,
        "keyframes": frames,
    }


def _described(error: Exception) -> dict[str, Any]:
    from splatmill_worker.errors import UnusablePicture, UnusableVideo

    if isinstance(error, UnusablePicture):
        return {"kind": "picture", "code": error.code, "name": error.facts["file"], "reason": error.reason}
    if isinstance(error, UnusableVideo):
        return {"kind": "video", "name": error.facts["file"], "reason": error.reason}
    if isinstance(error, OSError) and error.errno is not None:
        return {"kind": "system", "errno": error.errno, "text": error.strerror, "path": error.filename}
    if isinstance(error, MemoryError):
        return {"kind": "memory"}
    return {"kind": "other", "text": f"{type(error).__name__}: {error}"[:1000]}


if __name__ == "__main__":
    main()
