"""How much memory an attempt may use: what the machine has, what its control groups allow, and the worker's limit."""

import ctypes
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil

from splatmill_worker import settings

SHARE = 0.9
"""Share of the memory of the machine, or of its control group if that allows less, that an attempt may use where
SPLATMILL_MAX_MEMORY does not say. The rest is for the worker and, on one machine, for Redis and the API."""

_ROOT = Path("/")
_NO_LIMIT_V1 = 2**60
"""Version 1 of control groups writes a number near 2^63 where there is no limit."""


def attempt_limit() -> int | None:
    """Return how many bytes an attempt may use; None: no limit.

    Raises ValueError if SPLATMILL_MAX_MEMORY is no size.
    """
    chosen = settings.max_memory()
    if chosen is not None:
        return chosen or None
    allowed = group_limit()
    total = int(psutil.virtual_memory().total)
    return int(SHARE * (total if allowed is None else min(total, allowed)))


def available() -> int:
    """Return how many more bytes this process can use: free on the machine, in its control groups, and of its limit."""
    amounts = [int(psutil.virtual_memory().available)]
    amounts += [max(0, limit - taken) for limit, taken in _groups()]
    if (limit := attempt_limit()) is not None:
        amounts.append(max(0, limit - used()))
    return min(amounts)


def used() -> int:
    """Return the bytes that only this process can free, those in swap included, and its shared memory."""
    return sum(_memory_of(os.getpid()))


def return_freed() -> None:
    """Return to the system what was freed, also where it lies between things in use; glibc keeps that for itself.

    There is no effect with another C library. It takes a millisecond for each 100 MB.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def mapped_files() -> int:
    """Return the bytes of address space that the files mapped by this process take, such as its libraries."""
    if sys.platform != "linux":
        return 0
    with open("/proc/self/maps") as file:
        lines = [line.split() for line in file]
    ends = [words[0].split("-") for words in lines if len(words) > 5 and words[5].startswith("/")]
    return sum(int(end, 16) - int(begin, 16) for begin, end in ends)


def group_limit() -> int | None:
    """Return the smallest memory limit among this process's control groups in bytes, or None where there is none."""
    return min((limit for limit, _ in _groups()), default=None)


def _groups() -> Iterator[tuple[int, int]]:
    """Yield the limit, and the bytes in use that cannot be reclaimed, of each control group that has a limit."""
    if sys.platform != "linux":
        return
    try:
        lines = (_ROOT / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, controllers, path = line.split(":", 2)
        if number == "0" and not controllers:
            names = ("memory.max", "memory.current", "inactive_file")
            yield from _limits(_ROOT / "sys/fs/cgroup", path, *names)
        elif "memory" in controllers.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
            yield from _limits(_ROOT / "sys/fs/cgroup/memory", path, *names)


def _limits(mount: Path, path: str, limit: str, usage: str, reclaimable: str) -> Iterator[tuple[int, int]]:
    # A container may show the path that its group has on the host; then its own group is mounted at the root.
    group = mount / path.strip("/")
    for folder in (
        group,
        *(parent for parent in group.parents if parent == mount or mount in parent.parents),
    ):
        allowed = _number(folder / limit)
        if allowed is not None and allowed < _NO_LIMIT_V1:
            used = (_number(folder / usage) or 0) - _statistic(folder / "memory.stat", reclaimable)
            yield allowed, max(0, used)


def _number(path: Path) -> int | None:
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None


def _statistic(path: Path, name: str) -> int:
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.split()[:1] == [name]), 0)


class TreeMemory:
    """The memory of a process and of all that it started."""

    def __init__(self, root: int) -> None:
        self._root = root

    def used(self) -> int:
        """Return the bytes in use now: of each process what only it can free, and shared memory once.

        Pages of files do not count, because the kernel can drop them. Processes of other groups that have lost their
        parent are not found.
        """
        own, shared = 0, 0
        for pid in self._members():
            memory = _memory_of(pid)
            own += memory[0]
            shared = max(shared, memory[1])
        return own + shared

    def _members(self) -> list[int]:
        if sys.platform != "linux":
            try:
                root = psutil.Process(self._root)
                return [self._root, *(child.pid for child in root.children(recursive=True))]
            except psutil.Error:
                return []
        parents = dict(_processes())
        members = {self._root}
        grown = True
        while grown:
            more = {
                pid
                for pid, (parent, group) in parents.items()
                if pid not in members and (parent in members or group == self._root)
            }
            grown = bool(more)
            members |= more
        return sorted(members)


def _processes() -> Iterator[tuple[int, tuple[int, int]]]:
    """Yield the id of each process, with its parent and its process group."""
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            try:
                with open(f"/proc/{entry.name}/stat") as file:
                    fields = file.read().rpartition(")")[2].split()
            except OSError:
                continue  # it has ended
            yield int(entry.name), (int(fields[1]), int(fields[2]))


def _memory_of(pid: int) -> tuple[int, int]:
    """Return the private bytes of a process, those in swap included, and the shared ones; zeros if it has ended."""
    if sys.platform != "linux":
        try:
            return int(psutil.Process(pid).memory_info().rss), 0
        except psutil.Error:
            return 0, 0
    try:
        with open(f"/proc/{pid}/status") as file:
            fields = dict(line.split(":", 1) for line in file)
    except OSError:
        return 0, 0

    def bytes_of(name: str) -> int:
        return 1024 * int(fields[name].split()[0]) if name in fields else 0

    return bytes_of("RssAnon") + bytes_of("VmSwap"), bytes_of("RssShmem")
