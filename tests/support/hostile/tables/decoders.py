"""Code of a file that has taken its decoding process over: what it tries, and what becomes of that.

The acts are done by a real decoding process (`tests/support/decoding/forbidden_acts.py`) of a processor that the filter
knows.
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from functools import cache
from pathlib import Path

import pytest

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images import decode
from splatmill_worker.images.decoding.decoder import LENGTHS
from splatmill_worker.images.decoding.decoder_process import Call
from splatmill_worker.images.decoding.decoders import Decoders
from splatmill_worker.seccomp import ARCHITECTURES
from tests.support.decoding.acting import acts
from tests.support.hostile.bench import Answer, Bench
from tests.support.hostile.entry import Hostile

ACTS = {
    "chmod": "changes the mode of a file outside",
    "utime": "changes the times of a file outside",
    "setxattr": "sets an attribute of a file outside",
    "symlink": "makes a symbolic link for the attempt to follow",
    "link": "makes a hard link to a file outside",
    "create": "writes a file",
    "inherited file": "fills the disk by a file that was open when it started",
    "fork": "starts another process",
    "socket": "opens a connection",
    "prlimit of the parent": "lowers the limits of the attempt",
    "setpriority of the parent": "slows the attempt down",
    "kill the parent": "sends a signal to the attempt",
    "process_vm_readv": "reads the memory of the attempt",
    "io_uring_setup": "makes system calls by io_uring",
    "type into a terminal": "types into the terminal of the worker",
}
"""Names of `forbidden_acts`, with what they do."""

_OBJECTS = b'{"value": {"": ["|O8", [1]]}}'

_ANSWERS = {
    "ends": ("ends itself, as by a fault in a library", ""),
    "longer": ("announces an answer of a terabyte", LENGTHS.pack(2, 2**40).hex()),
    "pickle": (
        "answers with an array of Python objects",
        (LENGTHS.pack(len(_OBJECTS), 8) + _OBJECTS + bytes(8)).hex(),
    ),
}
"""What is answered in place of pixels, by a name: in words, and its bytes."""


@cache
def _outcomes() -> dict[str, str]:
    """What becomes of each act and answer, all in one job."""
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory(prefix="acts-") as folder:
        known = acts(patch)
        photo = Path(folder) / "job" / "photo.jpg"
        photo.parent.mkdir()
        outside = Path(folder) / "outside"
        for path in (photo, outside):
            path.write_bytes(b"of others")
        decoders = Decoders([photo.parent])
        try:
            outcomes = {
                name: decoders.call(Call(known.attempt, outside, (name, os.getpid())), str, UnusablePicture)
                for name in ACTS
            }
            for name, (_, content) in _ANSWERS.items():
                call = Call(known.answer, photo, (content,)) if content else Call(known.abort, photo)
                try:
                    decoders.call(call, decode.picture_of, UnusablePicture)
                except UnusablePicture as error:
                    outcomes[name] = error.reason
                decoders.forget_ended()
        finally:
            decoders.close()
        return outcomes


def _act(name: str) -> Answer:
    outcome = _outcomes()[name]
    return Answer("done" if outcome == "done" else "refused", "" if outcome == "done" else outcome)


def _entries() -> tuple[Hostile, ...]:
    area = "Code that has taken a decoder over"

    def act(name: str) -> Hostile:
        return Hostile(area, ACTS[name], lambda bench: _act(name), "refused", "EPERM")

    def answer(name: str, said: str) -> Hostile:
        def give(bench: Bench) -> Answer:
            return Answer("left out", _outcomes()[name])

        return Hostile(area, _ANSWERS[name][0], give, "left out", said)

    return (
        *map(act, ACTS),
        answer("ends", "its decoder was ended twice (signal 6)"),
        answer("longer", "not valid"),
        answer("pickle", "not valid"),
    )


DECODERS = _entries() if sys.platform == "linux" and platform.machine() in ARCHITECTURES else ()
