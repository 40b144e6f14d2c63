"""Takes from the calling process what it does not need: files, the network, other processes, and memory without bound.

On Linux, Landlock limits the files and seccomp the system calls; both hold for threads and processes that are started
later, and cannot be undone. Elsewhere only the limits of setrlimit hold. See landlock(7) and seccomp(2).
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import resource
import struct
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2

_EXECUTE, _WRITE, _READ, _READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_ALL_FILES = (1 << 13) - 1
"""The rights over files that the first version of Landlock knows."""

_LATER_FILES = {2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
"""Rights over files that came with later versions: moving between folders, truncation, device control."""

_TCP, _SCOPES = 0b11, 0b11
"""From version 4, TCP connections; from version 6, abstract unix sockets and signals to processes outside."""

_OWN_FILE = _EXECUTE | _WRITE | _READ | _LATER_FILES[3] | _LATER_FILES[5]
"""Rights that a rule for a file, not a folder, may carry."""

_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# Sockets; other processes' memory and files; other programs; interfaces that reach past this list.
_REFUSED_CALLS = {
    "x86_64": (41, 42, 53, 59, 101, 165, 272, 310, 311, 321, 322, 425, 438),
    "aarch64": (40, 97, 117, 198, 199, 203, 221, 270, 271, 280, 281, 425, 438),
}
"""Numbers of socket, connect, socketpair, execve, ptrace, mount, unshare, process_vm_readv, process_vm_writev, bpf,
execveat, io_uring_setup and pidfd_getfd."""

_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | errno.EPERM
_OTHER_ABI = 0x40000000


def confine(read: Iterable[Path], write: Iterable[Path], memory: int) -> tuple[str, ...]:
    """Confine this process, before it has threads. Returns what holds, of "files", "network" and "memory".

    read, write: the files and folders that it may still open; those that do not exist are left out.
    memory: bytes of address space that it may use.

    "files" and "network" are missing where the kernel has no Landlock or no seccomp. Raises OSError when a limit that
    the kernel offers cannot be set.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    held = []
    if sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        held.append("memory")
        libc = ctypes.CDLL(None, use_errno=True)
        libc.syscall.restype = ctypes.c_long
        _checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0), "no_new_privs")
        if _limit_files(libc, list(read), list(write)):
            held.append("files")
        if _refuse_calls(libc):
            held.append("network")
    return tuple(sorted(held))


def _checked(result: int, what: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return result


def _limit_files(libc: ctypes.CDLL, read: Sequence[Path], write: Sequence[Path]) -> bool:
    """Limit this process to these files by Landlock. Return False if the kernel has none."""
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
        for paths, rights in ((read, _READ | _READ_DIR), (write, files & ~_EXECUTE)):
            for path in paths:
                _allow(libc, rules, path, rights)
        _checked(libc.syscall(_RESTRICT_SELF, ctypes.c_int(rules), ctypes.c_uint32(0)), "landlock")
    finally:
        os.close(rules)
    return True


def _allow(libc: ctypes.CDLL, rules: int, path: Path, rights: int) -> None:
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        rule = struct.pack("=Qi", rights if path.is_dir() else rights & _OWN_FILE, handle)
        arguments = ctypes.c_int(rules), ctypes.c_int(_PATH_BENEATH), rule, ctypes.c_uint32(0)
        _checked(libc.syscall(_ADD_RULE, *arguments), f"landlock rule for {path}")
    finally:
        os.close(handle)


def _refuse_calls(libc: ctypes.CDLL) -> bool:
    """Let the calls of _REFUSED_CALLS fail with EPERM. Return False on a processor whose calls are not listed."""
    machine = platform.machine()
    if machine not in _AUDIT_ARCH:
        return False
    calls = _REFUSED_CALLS[machine]
    steps = [
        (_LOAD, 0, 0, 4),
        (_EQUAL, 1, 0, _AUDIT_ARCH[machine]),
        (_RETURN, 0, 0, _REFUSE),
        (_LOAD, 0, 0, 0),
    ]
    steps.append((_AT_LEAST, len(calls) + 1, 0, _OTHER_ABI))
    steps += [(_EQUAL, len(calls) - place, 0, number) for place, number in enumerate(calls)]
    steps += [(_RETURN, 0, 0, _ALLOW), (_RETURN, 0, 0, _REFUSE)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    program = ctypes.create_string_buffer(struct.pack("HP", len(steps), ctypes.addressof(code)))
    result = libc.prctl(_SET_SECCOMP, ctypes.c_ulong(_FILTER), program, 0, 0)
    if result < 0 and ctypes.get_errno() in (errno.EINVAL, errno.ENOSYS):
        return False  # a kernel built without seccomp
    return _checked(result, "seccomp") == 0
