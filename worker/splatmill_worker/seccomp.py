"""The system calls that a process which decodes may still make: all others fail. See seccomp(2).

The filter is a list of what is allowed. What remains can compute, take memory, start threads, and read; it cannot
change a file or its metadata, make or open one for writing, reach another process, start one, or use the network.
Which files can be read is for Landlock to limit (`sandbox`).

Proof, by the kinds of calls: descriptors can be read, written and closed, and none can be made but by `open` for
reading, so that only those that the process was given can be written to. `clone` makes threads of this process alone.
`tgkill` sends signals to this process alone, as `abort` does. `prlimit64` reads the limits of this process alone.
`ioctl`, `fcntl` and `prctl` are allowed for the requests listed. `tests/worker/test_sandbox.py` tries the others.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
from collections.abc import Iterator
from typing import NamedTuple

ARCHITECTURES = {"x86_64": (1, 0xC000003E), "aarch64": (2, 0xC00000B7)}
"""Column of `_TABLE`, and the kernel's AUDIT_ARCH, by the name of the machine."""

_TABLE = """
futex:202:98 read:0:63 write:1:64 newfstatat:262:79 mmap:9:222 munmap:11:215 mprotect:10:226 madvise:28:233
brk:12:214 mremap:25:216 rt_sigprocmask:14:135 rt_sigaction:13:134
lseek:8:62 close:3:57 fstat:5:80 readv:19:65 pread64:17:67 preadv:295:69 writev:20:66 dup:32:23
fadvise64:221:223 stat:4:- lstat:6:- statx:332:291 statfs:137:43 fstatfs:138:44 access:21:- faccessat:269:48
faccessat2:439:439 getdents64:217:61 readlink:89:- readlinkat:267:78 getcwd:79:17
rseq:334:293 set_robust_list:273:99 sched_yield:24:124 getcpu:309:168 sched_getaffinity:204:123
sched_getparam:143:121 sched_getscheduler:145:120 sched_get_priority_max:146:125
sched_get_priority_min:147:126 exit:60:93 exit_group:231:94 rt_sigreturn:15:139 sigaltstack:131:132
restart_syscall:219:128
poll:7:- ppoll:271:73 select:23:- pselect6:270:72 nanosleep:35:101 clock_nanosleep:230:115
clock_gettime:228:113 clock_getres:229:114 gettimeofday:96:169 time:201:- times:100:153
getpid:39:172 getppid:110:173 gettid:186:178 getuid:102:174 geteuid:107:175 getgid:104:176 getegid:108:177
getrlimit:97:163 getrusage:98:165 sysinfo:99:179 uname:63:160 getrandom:318:278
open:2:- openat:257:56 ioctl:16:29 fcntl:72:25 prctl:157:167 prlimit64:302:261 tgkill:234:131 clone:56:220
"""
"""The calls that are allowed, with their numbers on x86_64 and on aarch64 (-: it has no such call). First the frequent
ones, since the kernel compares in this order; then those on open files and on names of files; on threads and the end of
the process; on clocks and waiting; facts of the process and of the machine; and those of which `_conditions` limits the
arguments."""

_CLONE3 = 435
"""Its flags lie in memory, where a filter cannot read them. The C library falls back to `clone` where it is absent."""

_NEWEST = 451
"""Number, on both architectures, of the newest call that was known when `_TABLE` was written. Later ones are absent
here, as on an older kernel, so that libraries use those that they replace."""

_INSTALL = {"x86_64": 317, "aarch64": 277}
_SET_MODE_FILTER, _ALL_THREADS = 1, 1

_READ_ONLY = 0x3 | 0x40 | 0x200 | 0x400000
"""Of the flags of open: the access mode, O_CREAT, O_TRUNC and what makes O_TMPFILE of a folder. All must be 0."""

_SHARES = 0x100 | 0x800 | 0x10000
"""Flags of clone: CLONE_VM, CLONE_SIGHAND and CLONE_THREAD, which all must be set."""

_SEPARATES = 0x2000 | 0x4000 | 0x20000 | 0x7E000000
"""Flags of clone that must not be set: CLONE_PTRACE, CLONE_VFORK, and those that make namespaces."""

_TERMINAL_TEST, _CLOSE_ON_EXEC, _KEEP_ON_EXEC, _WAITING_BYTES = 0x5401, 0x5451, 0x5450, 0x541B
"""Requests of ioctl: TCGETS, with which libraries look for a terminal, FIOCLEX, FIONCLEX and FIONREAD."""

_DESCRIPTOR_REQUESTS = (0, 1, 2, 3, 4, 1030)
"""Requests of fcntl: to duplicate a descriptor, and to get and set its flags."""

_LOCK_REQUESTS = (5, 6, 7)
"""Requests of fcntl for locks: large photos take turns by one (`guarded.share_room`)."""

_NAME_REQUESTS = (15, 16, 0x53564D41)
"""Requests of prctl: to set and get the name of a thread, and to name memory."""

_LOAD, _AND, _EQUAL, _AT_LEAST, _ABOVE, _RETURN = 0x20, 0x54, 0x15, 0x35, 0x25, 0x06
_ALLOW, _REFUSE, _ABSENT, _KILL = 0x7FFF0000, 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS, 0x80000000
_OTHER_ABI = 0x40000000
"""Bit of the numbers of calls by the x32 ABI of x86_64."""

_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16
"""Offsets in the kernel's `struct seccomp_data`. An argument has 8 bytes, of which the lower 4 come first."""

Step = tuple[int, int, int, int]
"""An instruction: its code, how many to skip if a comparison holds and if it does not, and its operand."""


class Condition(NamedTuple):
    """What an argument must be: `value & mask` is one of `allowed`, where value is 4 bytes at `offset`."""

    offset: int
    allowed: tuple[int, ...]
    mask: int = 0xFFFFFFFF


def limit_calls(libc: ctypes.CDLL) -> bool:
    """Let all calls but those of this file fail in this process, in every thread.

    Return False on a processor whose calls are not listed, and on a kernel without seccomp. The process must have set
    no_new_privs. Raises OSError when the filter is refused.
    """
    machine = platform.machine()
    if machine not in ARCHITECTURES:
        return False
    steps = program(machine, os.getpid())
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    filters = ctypes.create_string_buffer(struct.pack("HP", len(steps), ctypes.addressof(code)))
    arguments = ctypes.c_uint(_SET_MODE_FILTER), ctypes.c_uint(_ALL_THREADS), filters
    if libc.syscall(ctypes.c_long(_INSTALL[machine]), *arguments) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS):
        return False
    raise OSError(number, f"seccomp: {os.strerror(number)}")


def program(machine: str, pid: int) -> list[Step]:
    """The filter for a machine of ARCHITECTURES, and for the process `pid`."""
    column, architecture = ARCHITECTURES[machine]
    steps: list[Step] = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _OTHER_ABI),
        (_RETURN, 0, 0, _KILL),
    ]
    limited = _conditions(pid)
    for entry in _TABLE.split():
        call = entry.split(":")
        if call[column] != "-":
            block = [*_checks(limited.get(call[0], ())), (_RETURN, 0, 0, _ALLOW)]
            steps += [(_EQUAL, 0, len(block), int(call[column])), *block]
    steps += [(_EQUAL, 0, 1, _CLONE3), (_RETURN, 0, 0, _ABSENT)]
    steps += [(_ABOVE, 0, 1, _NEWEST), (_RETURN, 0, 0, _ABSENT)]
    return [*steps, (_RETURN, 0, 0, _REFUSE)]


def _conditions(pid: int) -> dict[str, tuple[Condition, ...]]:
    """The conditions of the calls that are allowed with some arguments only."""

    def argument(index: int, *, upper: bool = False) -> int:
        return _ARGUMENTS + 8 * index + 4 * upper

    return {
        "open": (Condition(argument(1), (0,), _READ_ONLY),),
        "openat": (Condition(argument(2), (0,), _READ_ONLY),),
        "ioctl": (Condition(argument(1), (_TERMINAL_TEST, _CLOSE_ON_EXEC, _KEEP_ON_EXEC, _WAITING_BYTES)),),
        "fcntl": (Condition(argument(1), (*_DESCRIPTOR_REQUESTS, *_LOCK_REQUESTS)),),
        "prctl": (Condition(argument(0), _NAME_REQUESTS),),
        "prlimit64": (
            Condition(argument(0), (0, pid)),
            Condition(argument(2), (0,)),
            Condition(argument(2, upper=True), (0,)),
        ),
        "tgkill": (Condition(argument(0), (pid,)),),
        "clone": (Condition(argument(0), (_SHARES,), _SHARES | _SEPARATES),),
    }


def _checks(conditions: tuple[Condition, ...]) -> Iterator[Step]:
    """Refuse the call unless all conditions hold."""
    for offset, allowed, mask in conditions:
        yield _LOAD, 0, 0, offset
        yield _AND, 0, 0, mask
        for position, value in enumerate(allowed):
            yield _EQUAL, len(allowed) - position, 0, value
        yield _RETURN, 0, 0, _REFUSE
