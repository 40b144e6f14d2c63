"""Make a folder of links to the programs that tests may use: those of Debian's base system, and those of `.ci/programs`
with the packages that theirs depend on. A test that uses any other program does not find it, and fails.

    python3 .ci/links.py FOLDER
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

FOLDERS = ("/usr/local/sbin", "/usr/local/bin", "/usr/sbin", "/usr/bin", "/sbin", "/bin")
NO_MORE = ("recommends", "suggests", "conflicts", "breaks", "replaces", "enhances")
"""Relations of packages that a machine with nothing else need not have."""


def declared() -> Iterator[tuple[list[str], str]]:
    """Names of each program of `.ci/programs`, and its package."""
    for line in Path(__file__).with_name("programs").read_text().splitlines():
        if not line.startswith("#"):
            names, package, _ = line.split()
            yield names.split(","), package


def base() -> Iterator[str]:
    """Packages that every Debian has."""
    shown = "${Package} ${Essential} ${Priority}\n"
    for line in _lines("dpkg-query", "--show", f"--showformat={shown}"):
        name, *rest = line.split()
        if "yes" in rest or "required" in rest:
            yield name


def with_what_they_need(packages: Iterable[str]) -> set[str]:
    """These packages, and all installed ones that they depend on, by whichever alternative."""
    options = [f"--no-{relation}" for relation in NO_MORE]
    lines = _lines("apt-cache", "depends", "--recurse", "--installed", *options, *packages)
    return {line for line in lines if not line.startswith((" ", "<"))}


def files(packages: Iterable[str]) -> set[str]:
    """The files of these packages, where they lie in the end (/bin may be a link)."""
    installed = set(_lines("dpkg-query", "--show", "--showformat=${Package}\n"))
    listed = _lines("dpkg-query", "--listfiles", *sorted(installed & set(packages)))
    return set(map(os.path.realpath, listed))


def main(folder: Path) -> None:
    """Fill the folder."""
    programs = list(declared())
    allowed = files(with_what_they_need({"apt", *base(), *(package for _, package in programs)}))
    paths = {"python3": sys.executable}
    for place in filter(os.path.isdir, FOLDERS):
        for entry in os.scandir(place):
            # Names of Debian's alternatives, such as c++ and awk, belong to no package; what they lead to does.
            if os.path.realpath(entry.path) in allowed:
                paths.setdefault(entry.name, entry.path)
    for names, package in programs:
        present = {name: path for name in names if (path := paths.get(name) or shutil.which(name))}
        if not present:
            sys.exit(f"{names[0]} is not on PATH, and no package has installed it (Debian: {package}).")
        paths |= present
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in paths.items():
        (folder / name).symlink_to(path)


def _lines(*command: str) -> list[str]:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
