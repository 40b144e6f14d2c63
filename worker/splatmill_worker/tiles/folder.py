"""A plan on disk: a folder that any number of processes share, with the outputs of its units, each written whole."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatmill.files import atomic_write
from splatmill.process import ProcessIdentity
from splatmill_worker.errors import Refusal
from splatmill_worker.tiles.units import ScenePlan, State

PLAN, CAPTURES, UNITS, SCENE = "plan.json", "captures", "units", "scene"
"""The plan, captures by their digests, the outputs of the units, and a link to the output of the last one."""

LEFT_BY_KILLED = ("*.work", "*.claim", ".*.part")
"""What a process that was killed leaves among the outputs of the units."""

TILES = "tiles"
"""Folder of the plan in the folder of a run that trains its scene in tiles."""

CLAIM_SECONDS = 60.0
"""Age of a claim from which its process counts as gone."""

BEAT_SECONDS = 5.0
"""Time between two renewals of a claim by a process that runs."""

DONE = "done.json"
"""The file of an output that is written last; its folder is renamed after that."""


class Claimed(Exception):
    """Another process runs the unit."""


@dataclass(frozen=True)
class Ended:
    """How a unit ended.

    state: "done" or "failed".
    path: folder of its output; None where it failed.
    failure: the sentence that it failed with; empty where it did not.
    advice: what to do about that.
    """

    state: State
    path: Path | None = None
    failure: str = ""
    advice: str = ""


class PlanFolder:
    """The folder of a plan.

    root: the folder.
    plan: the plan.
    beat_seconds: time between two renewals of a claim.
    """

    def __init__(self, root: Path, plan: ScenePlan, *, beat_seconds: float = BEAT_SECONDS) -> None:
        self.root, self.plan, self.beat_seconds = root, plan, beat_seconds

    @staticmethod
    def open(root: Path) -> PlanFolder:
        """The folder in which a plan was saved. Raises Refusal where there is no plan, or none that can be read."""
        path = root / PLAN
        if not path.is_file():
            raise Refusal(
                "option_out_of_range",
                f"{root} has no {PLAN}.",
                advice="Make the plan first: splatmill plan PHOTOS -o FOLDER --tiles 4",
            )
        try:
            return PlanFolder(root, ScenePlan.from_dict(json.loads(path.read_text("utf-8"))))
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise Refusal(
                "option_out_of_range",
                f"{path} is not a plan that this version can read: {error}",
                advice="Make it again with splatmill plan; what its units have made is used where it still holds.",
            ) from error

    def save(self) -> None:
        """Write the plan."""
        self.root.mkdir(parents=True, exist_ok=True)
        atomic_write(self.root / PLAN, json.dumps(self.plan.as_dict(), indent=1))

    @property
    def capture(self) -> Path:
        """The folder of the photos. That of another capture has another name, so that none changes under a unit."""
        return self.root / CAPTURES / self.plan.digest[:16]

    def place(self, capture: Path) -> None:
        """Let the folder of the photos be a link to `capture`."""
        self.capture.parent.mkdir(parents=True, exist_ok=True)
        if self.capture.is_symlink():
            self.capture.unlink()  # it may lead to where the folder lay before
        self.capture.symlink_to(capture.resolve(), target_is_directory=True)

    def release(self) -> None:
        """Remove what earlier processes left that ended in the middle of a unit. The caller knows that none runs."""
        for path in [path for name in LEFT_BY_KILLED for path in (self.root / UNITS).glob(name)]:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def output(self, name: str) -> Path:
        """The folder that the output of a unit will have, by what has ended so far."""
        return self._path(name, self.states())

    def states(self) -> dict[str, State]:
        """The units that have ended, by name."""
        return {name: ended.state for name, ended in self.ended().items()}

    def ended(self) -> dict[str, Ended]:
        """How units have ended, by name, in the order of the plan."""
        ends: dict[str, Ended] = {}
        states: dict[str, State] = {}
        for unit in self.plan.units:
            if self.plan.depends_on_failures(unit.name) and self.plan.missing(unit.name, states):
                continue  # the name of its output is not known yet
            path = self._path(unit.name, states)
            if (path / DONE).is_file():
                ends[unit.name] = Ended("done", path)
            elif (failure := _read(path.with_suffix(".failed.json"))) is not None:
                ends[unit.name] = Ended("failed", None, str(failure["failure"]), str(failure["advice"]))
            else:
                continue
            states[unit.name] = ends[unit.name].state
        return ends

    def running(self, name: str, states: dict[str, State] | None = None) -> str | None:
        """Which process runs the unit, as text; None where none does. states: those there are, where they are known."""
        claim = self._path(name, self.states() if states is None else states).with_suffix(".claim")
        document = _read(claim)
        try:
            if document is None or self._age(claim) > CLAIM_SECONDS or _has_ended(claim):
                return None
        except FileNotFoundError:
            return None
        return f"{document.get('host')}, process {document.get('pid')}"

    def forget_failures(self, *names: str) -> None:
        """Let units that failed be run again."""
        states = self.states()
        # Before any is removed: the failures of units that did without others are named after these.
        failures = [self._path(name, states).with_suffix(".failed.json") for name in names]
        for failure in failures:
            failure.unlink(missing_ok=True)

    @contextmanager
    def claimed(self, name: str) -> Iterator[Run]:
        """Hold the unit `name`, so that no other process runs it, while the context lasts.

        Raises Claimed where another process holds it, and KeyError where the plan has no such unit.
        """
        path = self._path(name, self.states())
        path.parent.mkdir(parents=True, exist_ok=True)
        claim = path.with_suffix(".claim")
        token = uuid.uuid4().hex
        self._take(claim, token)
        work = path.with_name(f"{path.name}.{token}.work")
        work.mkdir()
        ended = threading.Event()
        held = threading.Event()
        held.set()
        beat = threading.Thread(target=self._renew, args=(claim, token, ended, held), daemon=True)
        beat.start()
        try:
            yield Run(name, path, work, held.is_set, lambda: _token(claim) == token)
        finally:
            ended.set()
            beat.join()
            shutil.rmtree(work, ignore_errors=True)
            if _token(claim) == token:
                claim.unlink(missing_ok=True)

    def _path(self, name: str, states: dict[str, State]) -> Path:
        return self.root / UNITS / f"{name}-{self.plan.key(name, states)}"

    def _take(self, claim: Path, token: str) -> None:
        """Write the claim. Raises Claimed where there is one that is still renewed."""
        process = ProcessIdentity.of(os.getpid()).dump()
        text = json.dumps({"token": token, "host": socket.gethostname(), **process})
        own = claim.with_name(f"{claim.name}.{token}")
        own.write_text(text, "utf-8")
        try:
            try:
                os.link(own, claim)  # fails where the claim exists, on network file systems too
            except FileExistsError:
                self._remove_stale(claim, token)
                try:
                    os.link(own, claim)
                except FileExistsError:
                    raise Claimed from None
        finally:
            own.unlink(missing_ok=True)

    def _remove_stale(self, claim: Path, token: str) -> None:
        """Remove a claim that nobody renews, with what its process left. Raises Claimed for one that is renewed."""
        gone = _token(claim)
        try:
            if self._age(claim) <= CLAIM_SECONDS and not _has_ended(claim):
                raise Claimed
            aside = claim.with_name(f"{claim.name}.{token}.stale")
            claim.rename(aside)
        except FileNotFoundError:
            return
        try:
            if _token(aside) != gone:  # another process was faster, and this claim is its own
                with suppress(FileExistsError):
                    os.link(aside, claim)
                raise Claimed
            shutil.rmtree(claim.with_name(f"{claim.stem}.{gone}.work"), ignore_errors=True)
        finally:
            aside.unlink(missing_ok=True)

    def _age(self, claim: Path) -> float:
        """Seconds since a claim was renewed, by the clock of the file system: those of machines differ."""
        now = claim.with_name(f"clock.{uuid.uuid4().hex}")
        now.touch()
        try:
            return now.stat().st_mtime - claim.stat().st_mtime
        finally:
            now.unlink(missing_ok=True)

    def _renew(self, claim: Path, token: str, ended: threading.Event, held: threading.Event) -> None:
        """Renew the claim until `ended`; clear `held` when it is another's, as after this process was frozen."""
        while not ended.wait(self.beat_seconds):
            try:
                mine = json.loads(claim.read_text("utf-8")).get("token") == token
                if mine:
                    os.utime(claim)
            except FileNotFoundError:
                mine = False
            except (OSError, ValueError):
                continue  # the file system does not answer; the claim holds for CLAIM_SECONDS
            if not mine:
                held.clear()
                return


@dataclass(frozen=True)
class Run:
    """A unit that this process holds.

    name: of the unit.
    path: folder that its output will have.
    work: folder for files of this run, removed when it ends.
    held: whether the unit is still this process's, as of the last renewal; false after it was frozen for long.
    owned: the same as of now, which reads the claim.
    """

    name: str
    path: Path
    work: Path
    held: Callable[[], bool]
    owned: Callable[[], bool]

    @property
    def out(self) -> Path:
        """The folder to write the output to."""
        return self.work / "out"

    def publish(self, facts: dict[str, Any]) -> None:
        """Make `out` the output of the unit, with `facts` in its last file. That of another process stays."""
        self.out.mkdir(exist_ok=True)
        atomic_write(self.out / DONE, json.dumps(facts, indent=1))
        try:
            self.out.rename(self.path)
        except OSError:
            if not (self.path / DONE).is_file():
                raise

    def fail(self, failure: str, advice: str) -> None:
        """Record that the unit cannot be done, unless another process has it by now."""
        if self.owned():
            document = json.dumps({"failure": failure, "advice": advice})
            atomic_write(self.path.with_suffix(".failed.json"), document)


def digest_of(capture: Path) -> str:
    """A digest of the names and contents of all files in a folder."""
    whole = hashlib.sha256()
    for path in sorted(path for path in capture.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        whole.update(f"{path.relative_to(capture).as_posix()}\0{content}\n".encode())
    return whole.hexdigest()


def facts_of(path: Path) -> dict[str, Any]:
    """The facts that a unit has published."""
    facts: dict[str, Any] = json.loads((path / DONE).read_text("utf-8"))
    return facts


def _read(path: Path) -> dict[str, Any] | None:
    try:
        document = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None


def _has_ended(claim: Path) -> bool:
    """Whether the process of a claim was one of this machine and runs no more; False where that cannot be seen.

    That the machine has been started again since then is not enough: machines that share the folder may have one name.
    """
    try:
        theirs = ProcessIdentity.load(_read(claim) or {})
        return bool(theirs.boot) and theirs.boot == ProcessIdentity.of(os.getpid()).boot and theirs.dead()
    except (KeyError, TypeError, ValueError, OSError):
        return False


def _token(claim: Path) -> str | None:
    document = _read(claim)
    return None if document is None else str(document.get("token"))
