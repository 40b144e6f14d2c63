"""The programs that come neither from PyPI nor from npm: `.ci/programs`, README.md and `.ci/run` name the same. Under
`.ci/run` tests find no others, and are not skipped for want of one. Images of others are named by digest.

Not proved here: that nothing else is needed (`make fresh` installs only this).
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support.paths import ROOT
from tests.support.programs import DECLARED, program

DOCKERFILES = sorted((ROOT / "docker").glob("*.Dockerfile"))


def packages(user: str) -> list[str]:
    """Debian's packages that `.ci/programs` has for "demo" or for "tests"."""
    return sorted(package for _, package, needs in DECLARED.values() if needs == user)


def installed_by(text: str) -> list[list[str]]:
    """The packages of each `apt-get install` that a page shows, in order."""
    return [sorted(line.split()) for line in re.findall(r"`apt-get install ([^`]*)`", " ".join(text.split()))]


def test_the_readme_names_every_program() -> None:
    text = (ROOT / "README.md").read_text()
    assert installed_by(text) == [packages("demo"), packages("tests")]
    (guide,) = re.findall(r"^apt-get install (.*)$", (ROOT / "docs/first-splat.md").read_text(), re.M)
    assert sorted(guide.split()) == packages("demo")
    assert not installed_by((ROOT / "CONTRIBUTING.md").read_text()), "it points to the README"
    assert "`.ci/programs`" in (ROOT / "CONTRIBUTING.md").read_text()


def test_ci_and_fresh_install_what_the_list_and_the_readme_name() -> None:
    run = (ROOT / ".ci/run").read_text()
    assert ".ci/programs" in run
    named = {name for names, package, _ in DECLARED.values() for name in (*names, package)}
    said = set(re.findall(r"apt-get install .*", run))
    assert said == {'apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null'}
    assert named.isdisjoint(" ".join(said).split())
    fresh = (ROOT / ".ci/fresh").read_text()
    script = fresh.split("packages() {")[1].split("\n")[0]
    read = f"cd {ROOT}; packages() {{{script}\npackages 1; packages 2"
    lines = subprocess.run(["bash", "-c", read], check=True, capture_output=True, text=True).stdout
    assert [sorted(line.split()) for line in lines.splitlines()] == [packages("demo"), packages("tests")]


def test_tests_ask_for_programs_in_one_place() -> None:
    """Otherwise a missing one would be a skipped test under `.ci/run`, too."""
    asking = [
        str(path.relative_to(ROOT))
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and node.attr == "which"
    ]
    assert asking == ["tests/support/programs.py"]


def test_a_missing_program_skips_a_test_and_fails_it_where_all_are_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PATH", "/nonexistent")
    monkeypatch.delenv("REQUIRE_PROGRAMS", raising=False)
    with pytest.raises(pytest.skip.Exception, match=r"promtool is not on PATH .*apt-get install prometheus"):
        program("promtool")
    monkeypatch.setenv("REQUIRE_PROGRAMS", "1")
    with pytest.raises(pytest.fail.Exception, match="promtool is not on PATH"):
        program("promtool")


@pytest.mark.skipif(not Path("/var/lib/dpkg/status").is_file(), reason="Debian's packages are asked")
def test_under_ci_tests_find_the_programs_of_the_list_and_no_others(tmp_path: Path) -> None:
    programs = [Path(program(name)).name for name in DECLARED]
    folder, mine = tmp_path / "links", tmp_path / "mine"
    mine.mkdir()
    for name in ("redis-server", "promtool"):
        (mine / name).write_text("#!/bin/sh\n")
        (mine / name).chmod(0o755)
    path = f"{mine}{os.pathsep}{os.environ['PATH']}"
    links = [sys.executable, str(ROOT / ".ci/links.py"), str(folder)]
    subprocess.run(links, check=True, env=os.environ | {"PATH": path}, timeout=120)
    made = {link.name for link in folder.iterdir()}
    assert made >= {*programs, "sh", "bash", "grep", "awk", "tar", "cc", "ld"}
    assert made.isdisjoint({"redis-server", "valkey-server", "node", "npm", "ffmpeg", "colmap"})
    (tmp_path / "a.cpp").write_text("int main() { return 7; }")
    build = "c++ a.cpp -o a && ./a"
    assert (
        subprocess.run([folder / "sh", "-c", build], cwd=tmp_path, env={"PATH": str(folder)}).returncode == 7
    )


def images() -> list[str]:
    """The images of others that compose and the Dockerfiles start from."""
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"].values()
    ours = [service["image"] for service in services if "build" not in service]
    return ours + [
        line.split()[1]
        for file in DOCKERFILES
        for line in file.read_text().splitlines()
        if line.startswith("FROM ")
    ]


def test_images_are_named_by_version_and_digest() -> None:
    names = images()
    assert len(DOCKERFILES) == 2
    assert {image.split(":")[0] for image in names} == {"redis", "caddy", "debian"}
    for image in names:
        assert re.fullmatch(r"[a-z]+:\S*\d[\d.]{4,}\S*@sha256:[0-9a-f]{64}", image)
    assert len(set(names)) == 3, "an image is the same one everywhere"
