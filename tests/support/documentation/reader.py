"""A reader who types what a page says: its shell and Python blocks, in order, in one folder.

What a page shows is made small before it runs; `SMALLER` and `ONCE_SMALLER` are the whole list of these changes.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.paths import ROOT

LOCAL = "http://127.0.0.1:8080"
READY = re.compile(r"Splatmill is ready at (\S+)")
START_SECONDS = 90.0
END = "\x04"
"""What the shell prints after a block that has run to its end."""

SMALLER = (
    # Budgets of one second, and photos of 120 pixels. So small photos need the highest effort for their cameras: asked
    # for, it is not tried after the two others.
    (r"^(splatmill train .*)--time-budget \S+", r"\1--time-budget 1s --sfm-effort high"),
    (r"--time-budget \S+", "--time-budget 1s"),
    (r'time_budget("?)([=:] ?)"\d[^"]*"', r'time_budget\1\2"1s", \1sfm_effort\1\2"high"'),
    (r"--steps \d+", "--steps 20"),
    (r"\bsteps=\d+", "steps=60"),
    (r"--image-size \d+", "--image-size 120"),
    (r"\bimage_size=\d+", "image_size=120"),
    (r"\bin range\(100\)", "in range(20)"),
    (r"\bin range\(1, 101\)", "in range(1, 21)"),
    (r"^(splatmill plan .*)--tiles \d+", r"\1--tiles 2 --steps 20 --image-size 120 --sfm-effort high"),
    # A command without a budget gets one, so that it ends.
    (r"(splatmill train (?!.*(?:--time-budget|--steps|--help)).+)", r"\1 --time-budget 1s --sfm-effort high"),
    # `make demo` writes into this folder instead of the repository's, without a video, from photos that are there.
    (
        r"^make demo$",
        'mkdir demo; cp -r photos demo; make -s -o .venv/.installed -C "$ROOT" demo '
        'OUT="$PWD/demo" PHOTOS="$PWD/demo/photos" '
        'ARGS="--novel-view --time-budget 1s --image-size 120 --sfm-effort high"',
    ),
    (r"^(splatmill clean .*--capture photos)", r"\1 --image-size 60"),
    # The port of the documentation may be in use here; the address is replaced when the service is up.
    (r"^((?:env \S+ )?)splatmill up\b", r'\1splatmill up --port 0 --data "$PWD/data"'),
)
ONCE = (
    "python -m splatmill_worker.synthetic photos\n",
    "splatmill train photos -o splat --time-budget 30s --novel-view\n",
)
"""Commands of the first page that run once for all pages: the others begin with the `photos` and `splat` they left."""
ONCE_SMALLER = (" --count 24 --width 208 --height 156 --samples 1", " --image-size 120")


def smaller(text: str) -> str:
    """A block's text with every change of `SMALLER` made."""
    for pattern, replacement in SMALLER:
        text = re.sub(pattern, replacement, text, flags=re.M)
    return text


@dataclass(frozen=True)
class Ran:
    """How a block ended: its status, and all that it printed, standard error included."""

    status: int
    printed: str


@dataclass
class Service:
    """A service that a page has started, and what it printed until it was ready."""

    process: subprocess.Popen[str]
    url: str
    printed: str


@dataclass
class Services:
    """The services that pages have started, by the command and its API key: two pages with the same share one."""

    running: dict[tuple[str, str], Service] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def stop(self) -> None:
        """End all of them, as Ctrl-C does."""
        for service in self.running.values():
            service.process.send_signal(signal.SIGINT)
        for service in self.running.values():
            service.process.wait(60)


@dataclass(frozen=True)
class Beginning:
    """The folder that the commands of `ONCE` have left, and what each of them printed."""

    folder: Path
    ran: dict[str, Ran]

    @classmethod
    def of(cls, folder: Path) -> Beginning:
        """Run the commands in a new folder."""
        folder.mkdir(parents=True)
        begin = Reader(folder, None, Services())
        ran = {
            command: begin.shell(command.replace("\n", f"{more}\n"))
            for command, more in zip(ONCE, ONCE_SMALLER, strict=True)
        }
        begin.close()
        return cls(folder, ran)


@dataclass
class Reader:
    """Runs the blocks of one page in `folder`, a copy of `beginning`; without one, `folder` is as it is."""

    folder: Path
    beginning: Beginning | None
    services: Services
    url: str = LOCAL
    environment: dict[str, str] = field(init=False)
    _shell: subprocess.Popen[str] | None = None
    _python: subprocess.Popen[str] | None = None

    def __post_init__(self) -> None:
        if self.beginning is not None:
            shutil.copytree(self.beginning.folder, self.folder)
        foreign = ("SPLATMILL_", "REDIS_URL", "COV_", "PYTEST_")
        kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
        self.environment = kept | {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "COLUMNS": "200",
            "ROOT": str(ROOT),
        }

    def shell(self, text: str) -> Ran:
        """Run a shell block in the page's shell, which ends where a command fails."""
        if self.beginning is not None and text in self.beginning.ran:
            return self.beginning.ran[text]
        if self._shell is None:
            self._shell = self._session("bash", "--norc", stderr=subprocess.STDOUT)
        assert self._shell.stdin is not None
        assert self._shell.stdout is not None
        block = self.folder / ".block"
        block.write_text(self._here(text))
        self._shell.stdin.write(f"set -e -o pipefail; source {block}; set +e; printf '{END}'\n")
        self._shell.stdin.flush()
        printed = ""
        while not printed.endswith(END):
            if not (more := self._shell.stdout.read(1)):
                ended, self._shell = self._shell, None
                ended.communicate()
                return Ran(ended.returncode, printed)
            printed += more
        return Ran(0, printed.removesuffix(END))

    def python(self, text: str) -> Ran:
        """Run a Python block in the session of the page; the status is 1 where it raised."""
        if self._python is None:
            self._python = self._session(
                sys.executable, "-u", str(Path(__file__).with_name("python_session.py"))
            )
        assert self._python.stdin is not None
        assert self._python.stdout is not None
        self._python.stdin.write(json.dumps(self._here(text)) + "\n")
        self._python.stdin.flush()
        answer = json.loads(self._python.stdout.readline())
        return Ran(answer["status"], answer["printed"])

    def serve(self, text: str) -> Ran:
        """Start the service of a block, or use the one that the same block started on another page."""
        key = self.shell("echo $SPLATMILL_API_KEY\n").printed.strip()
        running = self.services.running
        with self.services.lock:
            if (text, key) not in running:
                running[text, key] = self._start(smaller(text), key)
        self.url = running[text, key].url
        return Ran(0, running[text, key].printed)

    def close(self) -> None:
        """End the page's shell and its Python session."""
        for session in (self._shell, self._python):
            if session is not None:
                session.communicate()

    def _here(self, text: str) -> str:
        if LOCAL in text and self.url == LOCAL:
            self.serve("splatmill up\n")
        return smaller(text).replace(LOCAL, self.url)

    def _session(self, *command: str, stderr: int | None = None) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command,
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )

    def _start(self, text: str, key: str) -> Service:
        log = self.folder / "service.log"
        with log.open("w") as sink:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {text.strip()}"],
                cwd=self.folder,
                env=self.environment | {"SPLATMILL_API_KEY": key},
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                text=True,
            )
        end = time.monotonic() + START_SECONDS
        while (ready := READY.search(log.read_text())) is None:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.02)
        return Service(process, ready[1], log.read_text())
