"""What a decoding process can do, and what it cannot: code that has taken one over tries all that reaches beyond it.

Not proven here: the numbers and the code of the system call filter (test_seccomp), and that no fault of the kernel lets
it out.
"""

from __future__ import annotations

import os
import platform
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from splatmill_worker.errors import UnusablePicture
from splatmill_worker.images.decoding import decoders
from splatmill_worker.images.decoding.decoder import program_files
from splatmill_worker.images.decoding.decoders import Decoders, confined
from tests.support.decoding import forbidden_acts
from tests.support.decoding.acting import acts

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Landlock and seccomp are parts of Linux")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the job's folder, and with a file outside of it."""
    place = tmp_path_factory.mktemp("confined")
    (place / "job").mkdir()
    (place / "job" / "photo").write_text("of a stranger")
    (place / "outside").mkdir()
    return place


@pytest.fixture(scope="module")
def confinement(folder: Path) -> Iterator[tuple[Decoders, ModuleType]]:
    with pytest.MonkeyPatch.context() as patch:
        known = acts(patch)
        with confined([folder / "job"]) as started:
            held = started.ready()
            if held != ("calls", "files", "memory"):
                pytest.skip(f"this machine confines by {' and '.join(held)} alone")
            yield started, known


@pytest.mark.parametrize("name", forbidden_acts.names())
def test_an_act_is_refused_and_changes_nothing(
    name: str, folder: Path, confinement: tuple[Decoders, ModuleType]
) -> None:
    _, known = confinement
    target = folder / "outside" / "secret"
    target.write_text("of the service")
    photo = folder / "job" / "photo"
    before = state(target), state(photo)
    for path in (target, photo):
        if path is target or name != "read outside":
            outcome = decoders.call(known.attempt, path, name, os.getpid(), check=str)
            refusals = ("EPERM", "EACCES", "ENOSYS", "ENOMEM")
            assert outcome in refusals, f"{name} of {path.name}: {outcome}"
    assert (state(target), state(photo)) == before
    assert sorted(path.name for path in folder.rglob("*")) == ["job", "outside", "photo", "secret"]
    assert not Path("/dev/shm/splatmill-made").exists()


def state(target: Path) -> list[Any]:
    """All that an act could change: of a file, and of this process."""
    entry = target.stat()
    return [
        *(target.read_text(), entry.st_mode, entry.st_uid, entry.st_nlink, entry.st_mtime_ns),
        *(entry.st_ctime_ns, os.listxattr(target), sorted(os.listdir(target.parent))),
        *(resource.getrlimit(resource.RLIMIT_NOFILE), os.getpriority(os.PRIO_PROCESS, 0)),
        *(os.sched_getaffinity(0), os.sched_getscheduler(0), os.getpgid(0), os.getcwd()),
    ]


def test_what_decoding_needs_is_left(folder: Path, confinement: tuple[Decoders, ModuleType]) -> None:
    _, known = confinement
    assert decoders.call(known.threads, folder, 20, check=int) == 20
    assert decoders.call(known.read, folder / "job" / "photo", check=str) == "of a stranger"


def test_it_may_end_itself_as_the_c_library_does(
    folder: Path, confinement: tuple[Decoders, ModuleType]
) -> None:
    """abort() sends a signal to the own thread, which is allowed: the fault has its name."""
    _, known = confinement
    with pytest.raises(UnusablePicture, match=rf"ended twice \(signal {signal.SIGABRT:d}\)"):
        decoders.call(known.abort, folder / "job" / "photo", check=str)
    decoders.forget_ended()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="x86_64 also runs calls of 32 bits")
def test_calls_of_another_architecture_end_the_process(
    folder: Path, confinement: tuple[Decoders, ModuleType]
) -> None:
    _, known = confinement
    with pytest.raises(UnusablePicture, match=rf"ended twice \(signal {signal.SIGSYS:d}\)"):
        decoders.call(known.call_of_32_bits, folder / "job" / "photo", check=str)
    decoders.forget_ended()


def test_it_dies_first_when_memory_runs_out_and_has_no_rights_of_root(
    confinement: tuple[Decoders, ModuleType],
) -> None:
    started, _ = confinement
    started.ready()
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    (child,) = [pid for pid in children if b"acts" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert Path(f"/proc/{child}/oom_score_adj").read_text().strip() == "1000"
    status = Path(f"/proc/{child}/status").read_text()
    search_only = 1 << 2
    for name in ("CapPrm", "CapEff"):
        match = re.search(rf"^{name}:\s*(\w+)$", status, re.MULTILINE)
        assert match is not None
        assert int(match[1], 16) & ~search_only == 0
    assert re.search(r"^Seccomp:\s*2$", status, re.MULTILINE)
    assert re.search(r"^NoNewPrivs:\s*1$", status, re.MULTILINE)
    assert [os.readlink(f"/proc/{child}/fd/{number}").partition(":")[0] for number in (0, 1, 2)] == [
        "pipe"
    ] * 3


def test_the_decoding_program_confines_itself_before_it_loads_a_library() -> None:
    """Threads that run already would not be limited to files."""
    loaded = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, splatmill_worker.images.decoding.decoder as d; print(*sys.modules)",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert not {"numpy", "torch", "PIL", "av"} & set(loaded.stdout.split())
    assert all(path.exists() or path.is_relative_to("/lib64") for path in program_files()[:4])
