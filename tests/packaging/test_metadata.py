"""What the three pyproject.toml say alike, and what other files repeat of them.

Does not build anything: test_wheels.py does.
"""

from __future__ import annotations

import re
import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, metadata
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from tests.support.wheels import PARTS, ROOT

PROJECTS = {
    name: tomllib.loads((ROOT / folder / "pyproject.toml").read_text()) for name, folder in PARTS.items()
}
TOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PYTHONS = ("3.11", "3.12", "3.13")


@pytest.mark.parametrize("name", PARTS)
def test_every_part_describes_itself(name: str) -> None:
    project: dict[str, Any] = PROJECTS[name]["project"]
    assert project["name"] == name
    assert project["dynamic"] == ["version"]
    assert "version" not in project
    assert project["urls"] == PROJECTS["splatmill"]["project"]["urls"]
    assert project["license"] == "Apache-2.0"
    for file in (project["readme"], *project["license-files"]):
        assert (ROOT / PARTS[name] / file).is_file()
    assert (ROOT / PARTS[name] / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.mark.parametrize("name", PARTS)
def test_the_python_versions_are_the_same_everywhere(name: str) -> None:
    project: dict[str, Any] = PROJECTS[name]["project"]
    classified = re.findall(r"Python :: (3\.\d+)'", str(project["classifiers"]))
    assert tuple(classified) == PYTHONS
    assert project["requires-python"] == f">={PYTHONS[0]}"
    assert all(SpecifierSet(project["requires-python"]).contains(version) for version in classified)


def test_the_environment_has_the_tools_that_the_parts_are_built_with() -> None:
    """`make install` builds the worker without isolation, so what [build-system] asks for has to be installed."""
    group = {Requirement(text).name: Requirement(text) for text in TOOLS["dependency-groups"]["build"]}
    for project in PROJECTS.values():
        for text in project["build-system"]["requires"]:
            assert group[Requirement(text).name] == Requirement(text)


def test_every_tool_has_an_exact_version() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {re.sub(r"[-_.]+", "-", line.split("==")[0]).lower() for line in lines if "==" in line}
    for group in TOOLS["dependency-groups"].values():
        assert {
            re.sub(r"[-_.]+", "-", Requirement(text).name).lower() for text in group if isinstance(text, str)
        } <= pinned


def test_every_pinned_package_takes_the_oldest_python() -> None:
    """Debian 12 has 3.11.2, and a patch release that a tool asks for would keep `make test` from installing there."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    asked = {}
    for name in (line.split("==")[0] for line in lines if "==" in line):
        with suppress(PackageNotFoundError):  # of another system
            asked[name] = metadata(name)["Requires-Python"] or ""
    assert len(asked) > 150
    refused = {
        name: text for name, text in asked.items() if not SpecifierSet(text).contains(f"{PYTHONS[0]}.0")
    }
    assert not refused
