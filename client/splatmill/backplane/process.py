"""Processes that must not outlive others, and proof that a process is dead.

Both serve one promise: no attempt at a job keeps running unseen, and none begins while an older one may still run.
"""

import ctypes
import os
import signal
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_WATCH_SECONDS = 0.5


def die_with_parent(parent: int, sig: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel send `sig` to this process when its parent ends, however the parent ends.

    `parent` is the process id the caller knows its parent by, from before the fork: if the parent died between
    the fork and this call, no signal would ever come, so the process ends itself here and now. The kernel watches
    the parent's *thread*; fork from one that lives as long as the process. Where the kernel has no such call
    (macOS), a thread looks twice a second whether the parent is still there.
    """
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_PDEATHSIG, int(sig), 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) was refused")
    else:
        threading.Thread(target=_watch, args=(parent, sig), daemon=True, name="parent-watch").start()
    if os.getppid() != parent:
        os._exit(1)


def _watch(parent: int, sig: signal.Signals) -> None:
    while os.getppid() == parent:
        time.sleep(_WATCH_SECONDS)
    os.kill(os.getpid(), sig)


@dataclass(frozen=True)
class ProcessIdentity:
    """A process, told apart from every other one that ever had its number.

    machine is the host's id and name, boot the kernel's id of this boot, namespace that of the process numbers,
    started the process's start in clock ticks since boot. Fields a platform does not tell are empty.
    """

    machine: str
    boot: str
    namespace: str
    pid: int
    started: str

    @classmethod
    def of(cls, pid: int) -> "ProcessIdentity":
        """The identity of a process on this machine; ProcessLookupError when there is none."""
        started = start_time(pid)
        if started is None:
            raise ProcessLookupError(f"There is no process {pid}.")
        return cls(_machine(), _boot(), _namespace(), pid, started)

    @classmethod
    def load(cls, fields: dict[str, object]) -> "ProcessIdentity":
        """From what `dump` gave. Raises KeyError, TypeError or ValueError for anything else."""
        return cls(
            machine=str(fields["machine"]),
            boot=str(fields["boot"]),
            namespace=str(fields["namespace"]),
            pid=int(str(fields["pid"])),
            started=str(fields["started"]),
        )

    def dump(self) -> dict[str, object]:
        return asdict(self)

    def visible(self) -> bool:
        """Whether this machine can tell if the process lives: it ran here, in this namespace of process numbers,
        or before the last boot."""
        if self.machine != _machine():
            return False
        return self.boot != _boot() or self.namespace == _namespace()

    def dead(self) -> bool:
        """Whether the process is gone for certain. A process elsewhere never is, seen from here."""
        if not self.visible():
            return False
        return self.boot != _boot() or start_time(self.pid) != self.started


def start_time(pid: int) -> str | None:
    """Start of a live process in clock ticks since boot ("" where the platform does not tell), None for none.

    A zombie counts as gone: it runs nothing, and waits only to be noticed.
    """
    try:
        # The second field, the name in parentheses, may hold blanks and parentheses of its own.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        if sys.platform == "linux":
            return None
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return None
        except PermissionError:
            pass
        return ""
    return None if fields[0] in "ZX" else fields[19]


def wait_gone(pid: int, started: str | None, seconds: float) -> bool:
    """Wait until the process that began at `started` has ended; False when it still runs after `seconds`."""
    deadline = time.monotonic() + seconds
    while started is not None and start_time(pid) == started:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def _machine() -> str:
    # Containers of one image may share the id, and machines of two networks the name.
    return f"{_first_line('/etc/machine-id')}/{os.uname().nodename}"


def _boot() -> str:
    return _first_line("/proc/sys/kernel/random/boot_id")


def _namespace() -> str:
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _first_line(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""
