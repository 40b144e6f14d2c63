"""The documents say what is so: links lead somewhere, commands and settings exist, the Python runs as far as it can.

Does not prove the figures quoted: those are generated from the rows in worker/bench/results.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from typer.main import get_command

import splatmill
from splatmill.schema import describe_options

ROOT = Path(__file__).parent.parent
PAGES = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"]
PAGES += [str(p.relative_to(ROOT)) for p in sorted((ROOT / "worker").rglob("*.md")) if "build" not in p.parts]


def fenced(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.S)


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_lead_somewhere(page: str):
    text = (ROOT / page).read_text()
    targets = re.findall(r"\]\(([^)#\s]+)", text) + re.findall(r'src="([^"]+)"', text)
    missing = [t for t in targets if "://" not in t and not ((ROOT / page).parent / t).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES)
def test_every_make_target_named_exists(page: str):
    named = set(re.findall(r"`make ([a-z]+)", (ROOT / page).read_text()))
    named |= {t for block in fenced(page, "bash") for t in re.findall(r"^make ([a-z]+)", block, re.M)}
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    assert named <= targets


@pytest.mark.parametrize("page", PAGES)
def test_every_command_and_flag_named_exists(page: str):
    from splatmill.cli.app import app

    group = get_command(app)
    commands = {name: group.get_command(None, name) for name in group.list_commands(None)}
    flags = {flag for command in commands.values() for option in command.params for flag in option.opts}
    flags |= {"--help"} | {
        flag for command in commands.values() for option in command.params for flag in option.secondary_opts
    }
    for line in re.findall(
        r"splatmill ((?:train|up|jobs|status|cancel|render|orbit|doctor)\b[^`\n|]*)",
        (ROOT / page).read_text(),
    ):
        command, *rest = line.split()
        assert command in commands
        for flag in re.findall(r"--[a-z-]+", " ".join(rest)):
            assert flag in flags, f"{page}: splatmill {command} has no {flag}"


def test_the_readme_lists_its_prerequisites_and_commands():
    text = (ROOT / "README.md").read_text()
    for needed in ("make demo", "make test", "Python >= 3.11", "C++17"):
        assert needed in text


def test_the_readmes_python_uses_what_the_sdk_has():
    (block,) = fenced("README.md", "python")
    tree = ast.parse(block)
    imported = [
        a.name
        for n in ast.walk(tree)
        if isinstance(n, ast.ImportFrom) and n.module == "splatmill"
        for a in n.names
    ]
    assert imported
    assert all(hasattr(splatmill, name) for name in imported)
    called = {
        n.func.attr for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)
    }
    from splatmill.client import Client, JobHandle, ModelHandle

    known = set(dir(Client)) | set(dir(JobHandle)) | set(dir(ModelHandle)) | set(dir(splatmill.CameraSpec))
    assert called <= known
    options = {o.name for o in describe_options()} | {
        "name",
        "on_progress",
        "output",
        "format",
        "background",
        "quality",
    }
    given = {
        k.arg
        for n in ast.walk(tree)
        if isinstance(n, ast.Call)
        and isinstance(n.func, ast.Attribute)
        and n.func.attr in {"train", "render"}
        for k in n.keywords
    }
    assert given <= options


def test_the_paths_in_the_architecture_exist():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    worker = ROOT / "worker" / "splatmill_worker"
    paths = re.findall(r"`((?:client|server|worker|tests|kernels|splat|images|sfm)/[\w/.]*)`", text)
    missing = [p for p in paths if not (ROOT / p).exists() and not (worker / p).exists()]
    assert not missing
