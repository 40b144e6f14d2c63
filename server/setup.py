"""Gives this part the version of the client, which is the only place where a version is written.

In a checkout the client lies beside this folder; a source distribution carries its version in PKG-INFO.
"""

import re
from pathlib import Path

from setuptools import setup

FOLDER = Path(__file__).parent
SOURCES = {
    FOLDER / "PKG-INFO": r"^Version: (.+)$",
    FOLDER.parent / "client" / "splatmill" / "__init__.py": r'^__version__ = "(.+)"$',
}


def version() -> str:
    for path, pattern in SOURCES.items():
        if path.is_file():
            match = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
            if match is None:
                raise SystemExit(f"{path} names no version.")
            return match[1]
    raise SystemExit(f"Found no version: none of {', '.join(map(str, SOURCES))} is there.")


setup(version=version())
