"""Takes from the calling process what it does not need: files, the network, other processes, and memory without bound.

On Linux, Landlock limits the files that can be read and `seccomp` the system calls; both hold for threads that are
started later, and cannot be undone. Elsewhere neither does. See landlock(7) and seccomp(2).
"""

from __future__ import annotations

import ctypes
import os
import resource
import struct
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from splatmill_worker.seccomp import limit_calls

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38

_READ, _READ_DIR = 1 << 2, 1 << 3
_ALL_FILES = (1 << 13) - 1
"""The rights over files that the first version of Landlock knows."""

_LATER_FILES = {2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""Rights over files that came with later versions: moving between folders, truncation, device control."""

_TCP, _SCOPES = 0b11, 0b11
"""From version 4, TCP connections; from version 6, abstract unix sockets and signals to processes outside."""

_CAPABILITIES_VERSION, _SEARCH = 0x20080522, 1 << 2
"""Of capset(2), and CAP_DAC_READ_SEARCH: a worker that runs as root reads photos that belong to other users."""

FIRST_TO_DIE = "1000"
"""`oom_score_adj`: if the machine runs out of memory, the kernel kills this process before the attempt itself."""


def confine(read: Iterable[Path], memory: int) -> tuple[str, ...]:
    """Confine this process, before it has threads. Returns what holds, of "calls", "files" and "memory".

    read: the files and folders that it may still open, to read them; those that do not exist are left out.
    memory: bytes of address space that it may use.

    calls: it makes no system calls but those of `seccomp`; it has no network, no other process and no file to write.
    files: it opens no files but those of `read`.
    memory: its address space is limited.

    Each is missing where the system does not offer it. Raises OSError when a limit that is offered cannot be set.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    held = []
    if sys.platform == "linux":
        with suppress(OSError):  # hidden in some containers
            Path("/proc/self/oom_score_adj").write_text(FIRST_TO_DIE)
        # Also for files that are open already; pipes are not files.
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        held.append("memory")
        libc = ctypes.CDLL(None, use_errno=True)
        libc.syscall.restype = ctypes.c_long
        _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0), "no_new_privs")
        _drop_capabilities(libc)
        if _limit_files(libc, list(read)):
            held.append("files")
        if limit_calls(libc):
            held.append("calls")
    return tuple(sorted(held))


def _checked(result: int, what: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return result


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Give up what root may do, but for reading the files of other users, if this process may do that."""
    header = struct.pack("=Ii", _CAPABILITIES_VERSION, 0)
    held = ctypes.create_string_buffer(24)
    _checked(libc.capget(header, held), "capget")
    if any(held.raw):
        kept = struct.unpack("=6I", held.raw)[1] & _SEARCH
        _checked(libc.capset(header, struct.pack("=6I", kept, kept, 0, 0, 0, 0)), "capset")


def _limit_files(libc: ctypes.CDLL, read: Sequence[Path]) -> bool:
    """Limit this process to reading these files by Landlock. Return False if the kernel has none."""
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(1))
    if version < 1:
        return False
    files = _ALL_FILES | sum(bit for since, bit in _LATER_FILES.items() if version >= since)
    # Later fields that are zero are accepted by kernels that do not know them.
    attributes = struct.pack("QQQ", files, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
    rules = _checked(
        libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), ctypes.c_uint32(0)),
        "landlock",
    )
    try:
        for path in read:
            _allow(libc, rules, path)
        _checked(libc.syscall(_RESTRICT_SELF, ctypes.c_int(rules), ctypes.c_uint32(0)), "landlock")
    finally:
        os.close(rules)
    return True


def _allow(libc: ctypes.CDLL, rules: int, path: Path) -> None:
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        rule = struct.pack("=Qi", _READ | _READ_DIR if path.is_dir() else _READ, handle)
        arguments = ctypes.c_int(rules), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint32(0)
        _checked(libc.syscall(_ADD_RULE, *arguments), f"landlock rule for {path}")
    finally:
        os.close(handle)
