"""What a confined process can do, and what it cannot: each case runs in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from splatmill_worker.images.decoder import program_files

PROGRAM = """
import os, socket, subprocess, sys, threading
from pathlib import Path
from splatmill_worker.images.decoder import program_files
from splatmill_worker.sandbox import confine

read, write = Path(sys.argv[1]), Path(sys.argv[2])
print(*confine([*program_files(), read], [write], 2 << 30))
try:
    {case}
except (OSError, MemoryError) as error:
    print(type(error).__name__)
"""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Landlock and seccomp are parts of Linux")


def run(case: str, tmp_path: Path) -> list[str]:
    """Run `case` in a confined process; return what holds and what the case printed."""
    (tmp_path / "read").mkdir()
    (tmp_path / "write").mkdir()
    (tmp_path / "read" / "photo").write_text("of a stranger")
    (tmp_path / "secret").write_text("of the service")
    command = [sys.executable, "-c", PROGRAM.replace("{case}", case), tmp_path / "read", tmp_path / "write"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    held, *printed = ended.stdout.splitlines()
    if held != "files memory network":
        pytest.skip(f"this kernel confines by {held} alone")
    return printed


@pytest.mark.parametrize(
    ("case", "printed"),
    [
        ("print((read / 'photo').read_text())", "of a stranger"),
        ("(write / 'frame').write_text('x'); (write / 'frame').rename(write / 'b'); print('fine')", "fine"),
        ("print(len(os.urandom(4)))", "4"),
        ("threading.Thread(target=print, args=['thread']).start()", "thread"),
        ("import numpy, PIL.Image, pillow_heif, av; print('loaded')", "loaded"),
    ],
)
def test_what_decoding_needs_is_left(case: str, printed: str, tmp_path: Path) -> None:
    assert run(case, tmp_path) == [printed]


@pytest.mark.parametrize(
    "case",
    [
        "print((read.parent / 'secret').read_text())",
        "print(os.listdir(read.parent))",
        "(read / 'new').write_text('x')",
        "(read / 'photo').unlink()",
        "os.symlink('/etc/passwd', write / 'l'); print((write / 'l').read_text())",
        "print(open('/proc/self/environ').read())",
        "print(open(f'/proc/{os.getppid()}/environ').read())",
        "socket.socket()",
        "socket.socketpair()",
        "subprocess.run(['/bin/true'])",
        "os.execv('/bin/true', ['true'])",
        "print(len(bytearray(3 << 30)))",
    ],
)
def test_the_rest_is_refused(case: str, tmp_path: Path) -> None:
    assert run(case, tmp_path)[0] in ("PermissionError", "MemoryError")


def test_threads_started_before_are_not_confined_so_it_is_called_first(tmp_path: Path) -> None:
    """The decoding program confines itself before it loads a library that starts threads."""
    loaded = subprocess.run(
        [sys.executable, "-c", "import sys, splatmill_worker.images.decoder as d; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert not {"numpy", "torch", "PIL", "av"} & set(loaded.stdout.split())
    assert all(path.exists() or path.is_relative_to("/lib64") for path in program_files()[:4])
