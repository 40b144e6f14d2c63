"""The wheels of the three parts, and environments that hold them and what they need, without the source tree."""

from __future__ import annotations

import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, PathDistribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PARTS = {"splatmill": "client", "splatmill-server": "server", "splatmill-worker": "worker"}

WATCH = """
import os, sys

def note(text):
    log = os.open({log!r}, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(log, (text + "\\n").encode())
    os.close(log)

def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        path = os.path.realpath(os.fsdecode(arguments[0]))
        if path.startswith({folders!r}):
            note("opened " + path)

note("began " + " ".join(sys.orig_argv[1:]))
sys.addaudithook(watch)
"""
"""A module that logs each Python process that imports it, and each file of the source tree that it opens."""


def run(
    *command: str | Path, cwd: Path | None = None, env: dict[str, str] | None = None, timeout: float = 120
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and keep what it prints."""
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, timeout=timeout, cwd=cwd, env=env
    )


@dataclass(frozen=True)
class Built:
    """The two files that a part is distributed as."""

    wheel: Path
    sdist: Path


def build(folder: Path, out: Path, *formats: str) -> Built:
    """Build the part in `folder` with the tools installed here, into `out`.

    `formats` are options of `python -m build`: `--sdist` and `--wheel`, or none for an sdist and a wheel made from it.
    """
    done = run(
        sys.executable, "-m", "build", "--no-isolation", *formats, "--outdir", out, folder, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return Built(wheel, sdist)


def metadata(wheel: Path) -> Distribution:
    """The metadata in a wheel file."""
    with zipfile.ZipFile(wheel) as archive:
        (folder,) = {name.split("/")[0] for name in archive.namelist() if ".dist-info/" in name}
    return PathDistribution(zipfile.Path(wheel, f"{folder}/"))


def needed(wheels: Iterable[Path], extras: Mapping[str, str]) -> dict[str, Distribution]:
    """The distributions that the wheels declare to need, directly or not, as they are installed here.

    `extras` maps names of the parts to the extra that is asked of them.
    """
    ours: dict[str, Distribution] = {
        canonicalize_name(part.metadata["Name"]): part for part in map(metadata, wheels)
    }
    others: dict[str, Distribution] = {}
    known: set[tuple[str, frozenset[str]]] = set()
    waiting = [(name, frozenset({extras[name]} if name in extras else ())) for name in ours]
    while waiting:
        name, asked = waiting.pop()
        if (name, asked) in known:
            continue
        known.add((name, asked))
        if name not in ours:
            others[name] = distribution(name)
        for text in (ours | others)[name].requires or []:
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in asked | {""}):
                waiting.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    return others


def environment(folder: Path, *wheels: Path, **extras: str) -> Path:
    """Make an environment that holds these wheels and, as links, what they need; returns its `bin` folder.

    `extras` are as in pip's `server[embedded]`, by the folder of the part: `server="embedded"`.
    """
    names = {folder: name for name, folder in PARTS.items()}
    venv.create(folder, with_pip=False, symlinks=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    for installed in needed(wheels, {names[part]: extra for part, extra in extras.items()}).values():
        for top in {file.parts[0] for file in installed.files or []}:
            target = Path(str(installed.locate_file(top)))
            if not top.startswith(("..", "__")) and target.exists() and not (packages / top).exists():
                (packages / top).symlink_to(target)
    python = folder / "bin" / "python"
    done = run(
        *(sys.executable, "-m", "pip", "--python", python, "install"), "--no-deps", "--no-index", *wheels
    )
    assert done.returncode == 0, done.stderr
    return folder / "bin"


def watch(bin_folder: Path, log: Path) -> None:
    """Make every Python process of the environment log the files of the source tree that it opens."""
    (packages,) = bin_folder.parent.glob("lib/python*/site-packages")
    folders = tuple(f"{ROOT / part}/" for part in PARTS.values())
    # By a .pth file: Debian's Python has a sitecustomize of its own, which comes before one here.
    (packages / "_watch_opened.py").write_text(WATCH.format(log=str(log), folders=folders))
    (packages / "_watch_opened.pth").write_text("import _watch_opened\n")
