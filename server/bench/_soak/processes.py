"""The processes of the service, found by descent, with the role of each by its command line.

All are below this process: the supervisor is its child, and the kernel gives it those that lose their parent
(`orphans`). So no list says which processes there are: one that a part of the service starts has a role as soon as it
runs.
"""

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import psutil

from splatmill.process import start_time

SUPERVISOR, WORKER, TRAINER = "supervisor", "worker", "trainer"

_WORDS = {
    "splatmill_server.up": SUPERVISOR,
    "splatmill_server.up.api": "API",
    "splatmill_worker train": WORKER,
    "splatmill_worker renderer": "renderer",
    "splatmill_worker.images.decoding.decoder": "decoder",
}
"""Shorter names of programs. A program that is not among these is called by its own name."""

_FORKS = {WORKER: TRAINER}
"""Names of processes that run the program of their parent, by the role of the parent."""

_FORK = "fork of the "

_FORK_SECONDS = 1.0
"""Seconds after which a process that runs the program of its parent counts as a fork, which runs no other."""

_LOOK_SECONDS = 0.15


@dataclass(frozen=True)
class Member:
    """A process of the service.

    began: its start, which distinguishes it from a later process of the same id.
    line: the roles from the supervisor down to it, its own last.
    above: the processes from the supervisor down to its parent.
    """

    pid: int
    began: str
    line: tuple[str, ...]
    above: tuple[int, ...] = ()

    @property
    def role(self) -> str:
        """Its name, with that of its parent where it is not a part of the service itself."""
        named = (SUPERVISOR, WORKER)
        own = [role for role in reversed(self.line) if role not in named] or [self.line[-1]]
        return " of the ".join(own)

    @property
    def age(self) -> float:
        """Seconds since its start; infinity if it has ended."""
        try:
            return float(time.time() - psutil.Process(self.pid).create_time())
        except psutil.NoSuchProcess:
            return math.inf

    @property
    def runs(self) -> bool:
        """Whether the process has not ended."""
        return start_time(self.pid) == self.began


class Processes:
    """Lists the processes below this one, again and again, from `start` to `stop`.

    own: returns the children of this process that are no part of the service.
    top: the role of the first one, from which the others descend.
    roles: each role that has been met, and `members` each process.
    """

    def __init__(self, own: Callable[[], Iterable[int]], top: str = SUPERVISOR) -> None:
        self._own = own
        self._top = top
        self._before: dict[tuple[int, str], tuple[Member, float]] = {}
        self._looking = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="processes", daemon=True)
        self.roles: set[str] = set()
        self.members: set[Member] = set()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(10)

    def look(self) -> list[Member]:
        """Return the processes that run now and whose role is known.

        One that has just been forked has the command line of its parent until it runs its own program, so a role must
        last from one look to the next, and that of a fork _FORK_SECONDS. A process keeps its role without a parent.
        """
        with self._looking:
            moment = time.monotonic()
            now: dict[tuple[int, str], tuple[Member, float]] = {}
            known = []
            for member in self._tree():
                identity = member.pid, member.began
                before, since = self._before.get(identity, (None, moment))
                if before is not None and member.line[0] != self._top:
                    member = before
                if member != before:
                    since = moment
                now[identity] = member, since
                least = _FORK_SECONDS if member.line[-1].startswith(_FORK) else 0.0
                if moment - since > least and member.line[0] == self._top:
                    known.append(member)
            self._before = now
            self.members |= set(known)
            self.roles |= {member.role for member in known}
        return known

    def _run(self) -> None:
        while not self._stop.wait(_LOOK_SECONDS):
            self.look()

    def _tree(self) -> list[Member]:
        """Return the processes below this one but for its own, each after its parent."""
        members: dict[int, Member] = {}
        commands: dict[int, list[str]] = {}
        children: dict[int, list[psutil.Process]] = {}
        for process in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):  # it has ended since
                children.setdefault(process.ppid(), []).append(process)
        own = set(self._own())
        waiting = [process for process in children.get(os.getpid(), ()) if process.pid not in own]
        while waiting:
            process = waiting.pop()
            with suppress(psutil.Error):
                command, began = process.cmdline(), start_time(process.pid)
                parent = process.ppid()
                if command and began is not None:
                    above = members.get(parent)
                    role = role_of(command, commands.get(parent, ()), above.line[-1] if above else None)
                    line = (*above.line, role) if above else (role,)
                    pids = (*above.above, above.pid) if above else ()
                    members[process.pid] = Member(process.pid, began, line, pids)
                    commands[process.pid] = command
                waiting += children.get(process.pid, ())
        return list(members.values())


def role_of(command: Sequence[str], parent_command: Sequence[str], parent: str | None) -> str:
    """Return what a process is called by its command line.

    parent_command, parent: the command line of its parent, and what that is called.
    """
    if parent is not None and list(command) == list(parent_command):
        return _FORKS.get(parent, f"{_FORK}{parent}")
    name = _program(command)
    return _WORDS.get(name, name)


def _program(command: Sequence[str]) -> str:
    """Return the name of a program: of a Python module with its first word, or of a file."""
    program, *arguments = command
    name = os.path.basename(program)
    if not name.startswith("python"):
        return name
    if "-m" in arguments:
        module, *words = arguments[arguments.index("-m") + 1 :]
        return f"{module} {words[0]}" if words and words[0].isalpha() else module
    scripts = [os.path.basename(word) for word in arguments if not word.startswith("-")]
    return f"python {arguments[0]}" if arguments and arguments[0] == "-c" else (scripts or [name])[0]
