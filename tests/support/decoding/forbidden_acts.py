"""What code that has taken a decoding process over would try: acts on `target`, a file outside, and on the parent.

Run in a decoding process by `tests/worker/test_sandbox.py`, which loads this file there as `splatmill_worker.acts`.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
import platform
import resource
import signal
import socket
import stat
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.syscall.restype = ctypes.c_long
_COLUMN = 0 if platform.machine() == "x86_64" else 1
_NUMBERS = {
    "mount": (165, 40),
    "ptrace": (101, 117),
    "io_uring_setup": (425, 425),
    "userfaultfd": (323, 282),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "keyctl": (250, 219),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "shmget": (29, 194),
    "mq_open": (240, 180),
    "unshare": (272, 97),
    "setns": (308, 268),
    "personality": (135, 92),
    "seccomp": (317, 277),
    "tgkill": (234, 131),
    "tkill": (200, 130),
    "pidfd_open": (434, 434),
    "ioprio_set": (251, 30),
    "clone": (56, 220),
    "clone3": (435, 435),
    "inotify_init1": (294, 26),
    "fanotify_init": (300, 262),
    "rt_sigqueueinfo": (129, 138),
    "open_by_handle_at": (304, 265),
    "openat2": (437, 437),
    "splice": (275, 76),
    "copy_file_range": (326, 285),
    "vmsplice": (278, 75),
    "kexec_load": (246, 104),
    "fchmodat2": (452, 452),
    "move_mount": (429, 429),
    "landlock_create_ruleset": (444, 444),
    "prlimit64": (302, 261),
    "memfd_secret": (447, 447),
    "quotactl": (179, 60),
    "acct": (163, 89),
}


def _call(name: str, *arguments: Any) -> int:
    result = int(_LIBC.syscall(ctypes.c_long(_NUMBERS[name][_COLUMN]), *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), name)
    return result


def _long(value: int) -> ctypes.c_long:
    return ctypes.c_long(value)


def _fork() -> None:
    if os.fork() == 0:
        os._exit(0)


def _clone_without_thread() -> None:
    if _call("clone", _long(signal.SIGCHLD), None, None, None, None) == 0:
        os._exit(0)


def _inherited_file() -> None:
    """Write to each file that is open, such as the one by which large photos take turns."""
    written = 0
    for descriptor in range(32):
        try:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                written += os.write(descriptor, b"x")
        except OSError as error:
            if error.errno not in (errno.EBADF, errno.EFBIG):
                raise
    if not written:
        raise PermissionError(errno.EPERM, "no open file could be written to")


def _fchmod(target: Path) -> None:
    descriptor = os.open(target, os.O_RDONLY)
    os.fchmod(descriptor, 0o777)


def _acts(target: Path, parent: int) -> dict[str, Callable[[], Any]]:
    beside = target.with_name("made")
    return {
        "chmod": lambda: target.chmod(0o777),
        "fchmod": lambda: _fchmod(target),
        "fchmodat2": lambda: _call("fchmodat2", _long(-100), os.fsencode(target), _long(0o777), _long(0)),
        "chown": lambda: os.chown(target, 12345, 12345),
        "utime": lambda: os.utime(target, (1, 1)),
        "utimensat": lambda: os.utime(target, ns=(1, 1)),
        "setxattr": lambda: os.setxattr(target, "user.w", b"x"),
        "link": lambda: os.link(target, beside),
        "symlink": lambda: beside.symlink_to(target),
        "rename": lambda: target.rename(beside),
        "unlink": target.unlink,
        "mkdir": beside.mkdir,
        "mknod": lambda: os.mkfifo(beside),
        "truncate": lambda: os.truncate(target, 0),
        "open to write": lambda: os.open(target, os.O_WRONLY),
        "open to append": lambda: os.open(target, os.O_RDWR | os.O_APPEND),
        "create": lambda: os.open(beside, os.O_WRONLY | os.O_CREAT, 0o600),
        "create for reading": lambda: os.open(beside, os.O_RDONLY | os.O_CREAT, 0o600),
        "open to empty": lambda: os.open(target, os.O_RDONLY | os.O_TRUNC),
        "unnamed file": lambda: os.open(target.parent, os.O_TMPFILE | os.O_RDWR, 0o600),
        "openat2": lambda: _call("openat2", _long(-100), os.fsencode(target), bytes(24), _long(24)),
        "read outside": target.read_bytes,
        "shm_open": lambda: os.open("/dev/shm/splatmill-made", os.O_RDWR | os.O_CREAT, 0o600),
        "shmget": lambda: _call("shmget", _long(0), _long(4096), _long(0o1600)),
        "mq_open": lambda: _call(
            "mq_open", b"splatmill-made", _long(os.O_CREAT | os.O_RDWR), _long(0o600), None
        ),
        "memfd_create": lambda: os.memfd_create("made"),
        "memfd_secret": lambda: _call("memfd_secret", _long(0)),
        "inherited file": _inherited_file,
        "copy_file_range": lambda: _call(
            "copy_file_range", _long(0), None, _long(1), None, _long(1), _long(0)
        ),
        "splice": lambda: _call("splice", _long(0), None, _long(1), None, _long(1), _long(0)),
        "fork": _fork,
        "clone without a thread": _clone_without_thread,
        "clone3": lambda: _call("clone3", bytes(88), _long(88)),
        "subprocess": lambda: subprocess.run(["/bin/true"], check=False),
        "execve": lambda: os.execv("/bin/true", ["true"]),
        "unshare": lambda: _call("unshare", _long(0x10000000)),
        "setns": lambda: _call("setns", _long(0), _long(0)),
        "prlimit of the parent": lambda: resource.prlimit(parent, resource.RLIMIT_NOFILE, (64, 64)),
        "limits of the parent": lambda: resource.prlimit(parent, resource.RLIMIT_NOFILE),
        "own limits": lambda: _call("prlimit64", _long(0), _long(resource.RLIMIT_CORE), bytes(16), None),
        "setpriority of the parent": lambda: os.setpriority(os.PRIO_PROCESS, parent, 19),
        "affinity of the parent": lambda: os.sched_setaffinity(parent, {0}),
        "scheduler of the parent": lambda: os.sched_setscheduler(parent, os.SCHED_BATCH, os.sched_param(0)),
        "ioprio of the parent": lambda: _call("ioprio_set", _long(1), _long(parent), _long(3 << 13)),
        "kill the parent": lambda: os.kill(parent, signal.SIGURG),
        "kill the parent's group": lambda: os.killpg(0, 0),
        "tgkill the parent": lambda: _call("tgkill", _long(parent), _long(parent), _long(signal.SIGURG)),
        "tkill the parent": lambda: _call("tkill", _long(parent), _long(signal.SIGURG)),
        "queue a signal": lambda: _call("rt_sigqueueinfo", _long(parent), _long(signal.SIGURG), bytes(128)),
        "pidfd_open": lambda: _call("pidfd_open", _long(parent), _long(0)),
        "signals of a descriptor": lambda: fcntl.fcntl(0, fcntl.F_SETOWN, parent),
        "ptrace": lambda: _call("ptrace", _long(16), _long(parent), None, None),
        "process_vm_readv": lambda: _call(
            "process_vm_readv", _long(parent), bytes(16), _long(1), bytes(16), _long(1), _long(0)
        ),
        "process_vm_writev": lambda: _call(
            "process_vm_writev", _long(parent), bytes(16), _long(1), bytes(16), _long(1), _long(0)
        ),
        "memory of the parent": lambda: Path(f"/proc/{parent}/mem").open("rb"),
        "environment of the parent": lambda: Path(f"/proc/{parent}/environ").read_bytes(),
        "own environment": lambda: Path("/proc/self/environ").read_bytes(),
        "setsid": os.setsid,
        "setpgid": lambda: os.setpgid(0, 0),
        "setuid": lambda: os.setuid(os.getuid()),
        "chroot": lambda: os.chroot("/"),
        "chdir": lambda: os.chdir("/"),
        "mount": lambda: _call("mount", None, os.fsencode(target.parent), b"tmpfs", _long(0), None),
        "move_mount": lambda: _call("move_mount", _long(-100), b"/", _long(-100), b"/", _long(0)),
        "socket": socket.socket,
        "unix socket": lambda: socket.socket(socket.AF_UNIX),
        "socketpair": socket.socketpair,
        "netlink": lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW),
        "io_uring_setup": lambda: _call("io_uring_setup", _long(1), bytes(120)),
        "userfaultfd": lambda: _call("userfaultfd", _long(1)),
        "bpf": lambda: _call("bpf", _long(0), bytes(128), _long(128)),
        "perf_event_open": lambda: _call(
            "perf_event_open", bytes(128), _long(0), _long(-1), _long(-1), _long(0)
        ),
        "keyctl": lambda: _call("keyctl", _long(0), _long(-3), _long(1)),
        "seccomp": lambda: _call("seccomp", _long(1), _long(0), bytes(16)),
        "landlock": lambda: _call("landlock_create_ruleset", None, _long(0), _long(1)),
        "personality": lambda: _call("personality", _long(0xFFFFFFFF)),
        "inotify": lambda: _call("inotify_init1", _long(0)),
        "fanotify": lambda: _call("fanotify_init", _long(0), _long(0)),
        "open_by_handle_at": lambda: _call("open_by_handle_at", _long(-100), bytes(16), _long(0)),
        "kexec_load": lambda: _call("kexec_load", _long(0), _long(0), None, _long(0)),
        "quotactl": lambda: _call("quotactl", _long(0), None, _long(0), None),
        "acct": lambda: _call("acct", None),
        "prctl": lambda: _prctl(4, 1),
        "die with the parent": lambda: _prctl(1, 9),
        "type into a terminal": lambda: fcntl.ioctl(0, 0x5412, b"x"),
        "memory without bound": lambda: mmap.mmap(-1, 64 << 30),
    }


def _prctl(option: int, value: int) -> None:
    if _LIBC.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl")


def attempt(target: Path, name: str, parent: int) -> str:
    """Try an act, and return the name of its error, or "done"."""
    try:
        _acts(target, parent)[name]()
    except OSError as error:
        return errno.errorcode[error.errno or 0]
    return "done"


def names() -> list[str]:
    return list(_acts(Path("/x"), 0))


def threads(target: Path, count: int) -> int:
    """Start threads, as a decoder of videos does, and return how many have run."""
    done: list[int] = []
    started = [threading.Thread(target=done.append, args=(number,)) for number in range(count)]
    for thread in started:
        thread.start()
    for thread in started:
        thread.join()
    return len(done)


def read(target: Path) -> str:
    return target.read_text()


def abort(target: Path) -> None:
    """End as by a fault in a library."""
    os.abort()


def call_of_32_bits(target: Path) -> str:
    """Make a system call of the other architecture that x86_64 runs: getpid by int 0x80."""
    code = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    code.write(b"\xb8\x14\x00\x00\x00\xcd\x80\xc3")
    place = ctypes.addressof(ctypes.c_char.from_buffer(code))
    return str(ctypes.CFUNCTYPE(ctypes.c_int)(place)())


def answer(target: Path, written: bytes | str) -> None:
    """Write bytes where answers are written, in place of an answer."""
    _write_answer(bytes.fromhex(str(written)))
    os._exit(0)


def endless(target: Path, first: str, again: str) -> None:
    """Write bytes where answers are written, and others after them again and again, for twenty seconds."""
    _write_answer(bytes.fromhex(first))
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        _write_answer(bytes.fromhex(again))
        time.sleep(0.02)
    os._exit(0)


def _write_answer(content: bytes) -> None:
    for descriptor in range(3, 32):
        try:
            if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_WRONLY:
                os.write(descriptor, content)
        except OSError:
            continue
