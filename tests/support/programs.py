"""Programs that are not of Python: of Debian's packages, which `.ci/programs` lists, and of npm's, in Node.

A test that needs one which this machine lacks is skipped, with the reason. It fails where the environment variable
REQUIRE_PROGRAMS is set: `.ci/run` sets it, because it has installed all of them.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import NoReturn

import pytest

from tests.support.paths import ROOT
from web import packages

DECLARED: dict[str, tuple[tuple[str, ...], str, str]] = {
    names.split(",")[0]: (tuple(names.split(",")), package, user)
    for names, package, user in (
        line.split() for line in (ROOT / ".ci/programs").read_text().splitlines() if not line.startswith("#")
    )
}
"""Program -> the names it may have, Debian's package, and what needs it first ("demo" or "tests")."""


def program(name: str) -> str:
    """Return the path of a program of `.ci/programs`, under any of its names."""
    names, package, _ = DECLARED[name]
    path = next((file for each in names if (file := shutil.which(each))), None)
    return path or _lacking(f"{name} is not on PATH (Debian: apt-get install {package})")


def npm_package(name: str) -> Path:
    """Return the folder of a package of `server/web/package.json`."""
    folder: Path = packages.INSTALLED / name
    if not folder.is_dir():
        _lacking(f"{name} is not installed: run `python server/web/packages.py fetch --dev`")
    return folder


def node(package: str) -> list[str]:
    """Return the command that runs Node, for a test that needs this package of npm."""
    npm_package(package)
    return packages.node()


def _lacking(what: str) -> NoReturn:
    """Skip the test, or fail it where nothing may be lacking."""
    if os.environ.get("REQUIRE_PROGRAMS"):
        pytest.fail(what)
    pytest.skip(what)
