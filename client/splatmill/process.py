"""Processes that end with their parent, and a reliable test whether a process has ended.

Together they ensure that no attempt at a job runs unnoticed, and that none begins while an earlier one may still run.
A unit of a scene in tiles whose process was killed is free at once by the same test.
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

    `parent` is the parent's process id, read before the fork: if the parent ended between the fork and this call, no
    signal would ever arrive, so this process then exits at once. Linux watches the *thread* that forked, so fork from
    one that lives as long as the parent. On other systems (macOS), a thread checks twice a second whether the parent
    still exists.
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
    """A unique identity of a process: process ids are reused, these are not. Fields unknown on a platform are empty.

    machine: machine id and host name.
    boot: the kernel's id of the current boot.
    namespace: the namespace that the process id belongs to.
    pid: process id.
    started: start of the process in clock ticks since boot.
    """

    machine: str
    boot: str
    namespace: str
    pid: int
    started: str

    @classmethod
    def of(cls, pid: int) -> "ProcessIdentity":
        """Return the identity of a process on this machine. Raises ProcessLookupError if there is none."""
        started = start_time(pid)
        if started is None:
            raise ProcessLookupError(f"There is no process {pid}.")
        return cls(_machine(), _boot(), _namespace(), pid, started)

    @classmethod
    def load(cls, fields: dict[str, object]) -> "ProcessIdentity":
        """Return the identity that `dump` wrote. Raises KeyError, TypeError or ValueError for other fields."""
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
        """Return whether this machine can tell if the process runs: it belongs to this machine, and to this namespace
        of process ids or to an earlier boot."""
        if self.machine != _machine():
            return False
        return self.boot != _boot() or self.namespace == _namespace()

    def dead(self) -> bool:
        """Return whether the process has certainly ended. This cannot be known of a process elsewhere."""
        if not self.visible():
            return False
        return self.boot != _boot() or start_time(self.pid) != self.started


def start_time(pid: int) -> str | None:
    """Return the start of a running process in clock ticks since boot ("" where that is unknown), or None.

    A zombie counts as ended: it only waits for its parent to read its status.
    """
    try:
        # The second field, the name in parentheses, may itself contain spaces and parentheses.
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
    """Wait until the process that began at `started` has ended; return False if it still runs after `seconds`."""
    deadline = time.monotonic() + seconds
    while started is not None and start_time(pid) == started:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


def _machine() -> str:
    # Containers of one image may share the machine id, and machines in two networks the host name.
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
