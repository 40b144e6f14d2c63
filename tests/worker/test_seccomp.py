"""The system call filter of each architecture, against the kernel's own headers and run by an interpreter of its code.

So the filter of the machine that the tests do not run on is compared with that machine's numbers, and executed; but no
kernel of that machine has loaded it. Not proved here: what a confined process can do (test_sandbox).
"""

from __future__ import annotations

import errno
import platform
import re
import struct
import subprocess
import sys
from collections.abc import Sequence
from functools import cache

import pytest

from splatmill_worker import seccomp
from splatmill_worker.seccomp import Step
from tests.support.programs import program

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="seccomp is a part of Linux")

PID = 4711
ALLOW, KILL = 0x7FFF0000, 0x80000000
EPERM, ENOSYS = 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS

CALLS = {
    "x86_64": "#include <asm/unistd_64.h>\n",
    # What arm64's own unistd.h asks of the generic table, which it includes.
    "aarch64": "".join(
        f"#define __ARCH_WANT_{name}\n"
        for name in (
            "RENAMEAT",
            "NEW_STAT",
            "SET_GET_RLIMIT",
            "TIME32_SYSCALLS",
            "SYS_CLONE3",
            "MEMFD_SECRET",
        )
    )
    + "#include <asm-generic/unistd.h>\n",
}
"""The header with the numbers of calls, as a program in C includes it on each architecture."""

CONSTANTS = "".join(
    f"#include <{name}.h>\n"
    for name in ("asm-generic/fcntl", "asm-generic/ioctls", "linux/audit", "linux/prctl", "linux/sched")
)
"""The headers with the values of arguments. Those that are used here are the same on both architectures."""

NEVER = [
    "execve",
    "execveat",
    "fork",
    "vfork",
    "socket",
    "connect",
    "bind",
    "sendto",
    "sendmsg",
    "accept4",
    "ptrace",
    "kill",
    "tkill",
    "pidfd_send_signal",
    "process_vm_readv",
    "process_vm_writev",
    "unlink",
    "unlinkat",
    "rename",
    "renameat",
    "renameat2",
    "link",
    "linkat",
    "symlinkat",
    "mkdirat",
    "mknodat",
    "chmod",
    "fchmod",
    "fchmodat",
    "fchownat",
    "utimensat",
    "setxattr",
    "fsetxattr",
    "truncate",
    "ftruncate",
    "fallocate",
    "openat2",
    "open_by_handle_at",
    "mount",
    "umount2",
    "chroot",
    "pivot_root",
    "setns",
    "unshare",
    "bpf",
    "perf_event_open",
    "io_uring_setup",
    "userfaultfd",
    "memfd_create",
    "init_module",
    "finit_module",
    "kexec_load",
    "reboot",
    "setuid",
    "setgid",
    "capset",
    "setpriority",
    "sched_setaffinity",
    "setrlimit",
    "sethostname",
    "add_key",
    "keyctl",
    "seccomp",
    "copy_file_range",
    "splice",
    "sendfile",
    "pwrite64",
    "inotify_init1",
    "fanotify_init",
    "shmget",
    "msgget",
]
"""Calls that reach beyond a decoding process."""


@cache
def values(includes: str, *names: str) -> dict[str, int]:
    """The values of macros in headers of the kernel, by name. A macro that is not defined is left out."""
    source = includes + "".join(f"\nVALUE {name} = ({name})" for name in names)
    command = [program("c++"), "-E", "-P", "-x", "c", "-"]
    ran = subprocess.run(command, input=source, capture_output=True, text=True, check=False)
    if ran.returncode:
        pytest.skip(f"the headers of the kernel are not installed: {ran.stderr.strip().splitlines()[0]}")
    numbers = {}
    # The name itself is replaced too, so that the lines are told apart by their order.
    for name, line in zip(names, re.findall(r"^VALUE .* = (.*)$", ran.stdout, re.MULTILINE), strict=True):
        if re.fullmatch(r"[\d\sa-fA-FxX|+()]+", line):
            numbers[name] = int(eval(re.sub(r"\b0([0-7]+)\b", r"0o\1", line)))
    return numbers


def number_of_calls(machine: str, names: Sequence[str]) -> dict[str, int]:
    """The numbers of the kernel's calls on an architecture, by name."""
    if machine == "x86_64" and platform.machine() != "x86_64":
        pytest.skip("the headers of x86_64 are part of its own machines alone")
    numbers = values(CALLS[machine], *(f"__NR_{name}" for name in names))
    return {name.removeprefix("__NR_"): number for name, number in numbers.items()}


def table(machine: str) -> dict[str, int | None]:
    """The calls of the filter's table, with their numbers."""
    column = seccomp.ARCHITECTURES[machine][0]
    entries = [entry.split(":") for entry in seccomp._TABLE.split()]
    return {entry[0]: None if entry[column] == "-" else int(entry[column]) for entry in entries}


def verdict(machine: str, number: int, *arguments: int, architecture: int | None = None) -> int:
    """What the filter decides on a call, by the rules of classic BPF for the instructions that it may use."""
    steps: list[Step] = seccomp.program(machine, PID)
    own = seccomp.ARCHITECTURES[machine][1]
    six = [*arguments, *[0] * (6 - len(arguments))]
    data = struct.pack("<iIQ6Q", number, own if architecture is None else architecture, 0, *six)
    accumulator = at = 0
    while True:
        code, yes, no, operand = steps[at]
        at += 1
        match code:
            case 0x20:
                assert operand % 4 == 0
                (accumulator,) = struct.unpack_from("<I", data, operand)
            case 0x54:
                accumulator &= operand
            case 0x15:
                at += yes if accumulator == operand else no
            case 0x35:
                at += yes if accumulator >= operand else no
            case 0x25:
                at += yes if accumulator > operand else no
            case 0x06:
                return operand
            case _:
                raise AssertionError(f"the instruction {code:#x} is none that the filter uses")


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_the_numbers_are_those_of_the_kernel(machine: str) -> None:
    own = table(machine)
    kernel = number_of_calls(machine, [*own, "clone3", "seccomp"])
    assert {name: kernel.get(name) for name in own} == own
    assert kernel["clone3"] == seccomp._CLONE3
    assert kernel["seccomp"] == seccomp._INSTALL[machine]
    assert sum(number is not None for number in own.values()) > 50


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_the_values_of_arguments_are_those_of_the_kernel(machine: str) -> None:
    def of(*names: str) -> list[int]:
        numbers = values(CONSTANTS, *names)
        return [numbers[name] for name in names]

    assert of(f"AUDIT_ARCH_{machine.upper()}") == [seccomp.ARCHITECTURES[machine][1]]
    assert sum(of("O_ACCMODE", "O_CREAT", "O_TRUNC", "__O_TMPFILE")) == seccomp._READ_ONLY
    assert sum(of("CLONE_VM", "CLONE_SIGHAND", "CLONE_THREAD")) == seccomp._SHARES
    spaces = ("CGROUP", "UTS", "IPC", "USER", "PID", "NET")
    apart = of("CLONE_PTRACE", "CLONE_VFORK", "CLONE_NEWNS", *(f"CLONE_NEW{name}" for name in spaces))
    assert sum(apart) == seccomp._SEPARATES
    assert of("TCGETS", "FIOCLEX", "FIONCLEX", "FIONREAD") == [
        seccomp._TERMINAL_TEST,
        seccomp._CLOSE_ON_EXEC,
        seccomp._KEEP_ON_EXEC,
        seccomp._WAITING_BYTES,
    ]
    descriptors = of("F_DUPFD", "F_GETFD", "F_SETFD", "F_GETFL", "F_SETFL")
    assert (*descriptors, 1024 + 6) == seccomp._DESCRIPTOR_REQUESTS
    assert tuple(of("F_GETLK", "F_SETLK", "F_SETLKW")) == seccomp._LOCK_REQUESTS
    assert tuple(of("PR_SET_NAME", "PR_GET_NAME", "PR_SET_VMA")) == seccomp._NAME_REQUESTS


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_the_filter_fits_the_kernel_on_each_architecture(machine: str) -> None:
    """Jumps stay inside, and each path ends in a verdict: what the kernel checks when it loads a filter."""
    steps = seccomp.program(machine, 4711)
    assert len(steps) < 4096
    for number, (code, yes, no, _) in enumerate(steps):
        assert max(yes, no) < 256
        if code & 0x07 == 0x05:
            assert number + 1 + max(yes, no) < len(steps)
    assert steps[-1] == (0x06, 0, 0, 0x50001)


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_of_all_numbers_those_of_the_table_are_allowed(machine: str) -> None:
    limited = seccomp._conditions(PID)
    own = {number: name for name, number in table(machine).items() if number is not None}
    for number in range(1024):
        name = own.get(number)
        answer = verdict(machine, number)
        if name is None:
            absent = number == seccomp._CLONE3 or number > seccomp._NEWEST
            assert answer == (ENOSYS if absent else EPERM), number
        elif name not in limited:
            assert answer == ALLOW, name
    for number in (0x40000000, 0x40000001, 0x7FFFFFFF, -1):
        assert verdict(machine, number) == KILL
    for other in {0x40000003, 0x40000028, 0, *(two for _, two in seccomp.ARCHITECTURES.values())}:
        if other != seccomp.ARCHITECTURES[machine][1]:
            assert verdict(machine, min(own), architecture=other) == KILL


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_no_call_that_reaches_beyond_the_process_is_allowed(machine: str) -> None:
    known = number_of_calls(machine, NEVER)
    assert len(known) > 50
    for name, number in known.items():
        assert verdict(machine, number, PID, 0, 0) in (EPERM, ENOSYS), name


@pytest.mark.parametrize("machine", seccomp.ARCHITECTURES)
def test_arguments_decide_where_a_call_is_allowed_in_part(machine: str) -> None:
    calls = table(machine)

    def of(name: str, *arguments: int) -> bool:
        number = calls[name]
        assert number is not None
        answer = verdict(machine, number, *arguments)
        assert answer in (ALLOW, EPERM)
        return answer == ALLOW

    close_on_exec, directory = 0o2000000, 0o200000 if machine == "x86_64" else 0o40000
    here = 2**64 - 100
    assert of("openat", here, 1, 0)
    assert of("openat", here, 1, close_on_exec | directory)
    for flags in (0o1, 0o2, 0o3, 0o100, 0o1000, 0o20000000, 0o20000000 | directory | 0o2):
        assert not of("openat", here, 1, close_on_exec | flags), oct(flags)
    threads = 0x100 | 0x200 | 0x400 | 0x800 | 0x10000 | 0x40000 | 0x80000 | 0x100000 | 0x200000 | 0x1000000
    assert of("clone", threads)
    assert not of("clone", 17), "as fork does"
    assert not of("clone", 0x4000 | 0x100 | 17), "as vfork does"
    for flag in (0x2000, 0x20000, 0x2000000, 0x10000000, 0x20000000, 0x40000000):
        assert not of("clone", threads | flag), hex(flag)
    assert of("tgkill", PID, 1, 6)
    assert not of("tgkill", PID + 1, 1, 6)
    assert of("prlimit64", 0, 7, 0, 1)
    assert of("prlimit64", PID, 7, 0, 1)
    assert not of("prlimit64", 1, 7, 0, 1)
    assert not of("prlimit64", 0, 7, 1, 0)
    assert not of("prlimit64", 0, 7, 1 << 32, 0), "an address with lower bytes of zero is one"
    assert of("ioctl", 1, 0x5401)
    assert not of("ioctl", 1, 0x5412), "to type into a terminal"
    assert of("fcntl", 1, 1030)
    assert not of("fcntl", 1, 8), "to choose who gets signals"
    assert of("prctl", 15)
    assert not of("prctl", 4, 1), "to be dumped"
