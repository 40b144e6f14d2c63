"""The pages name what exists: links and pictures lead somewhere, and so do make targets, commands, flags and paths.

Does not prove what a page says about them, nor the figures quoted, which are generated from the rows in
worker/bench/results.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from docs.generate import COMMITTED
from docs.generate import PAGES as GENERATED
from typer.main import get_command

from splatmill.cli.app import COMMANDS, app
from splatmill.schema import PROBLEMS, describe_options
from splatmill_worker.splat.plan.plan import Plan
from splatmill_worker.splat.plan.reasons import BY_OPTION
from tests.support.documentation.markdown import GUIDES, blocks, without_blocks
from tests.support.paths import ROOT

PAGES = [
    *sorted(ROOT.glob("*.md")),
    *GUIDES,
    *sorted(page for page in (ROOT / "worker").rglob("*.md") if "build" not in page.parts),
]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def shell_of(page: Path) -> str:
    return "\n".join(block.text for block in blocks(page) if block.language == "bash")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    text = without_blocks(page.read_text())
    targets = re.findall(r"\]\(([^)#\s]+)", text) + re.findall(r'src="([^"]+)"', text)
    generated = {ROOT / "docs" / "generated" / name for name in GENERATED}
    places = {target: (page.parent / target).resolve() for target in targets if "://" not in target}
    assert not [target for target, place in places.items() if not place.exists() and place not in generated]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_make_target_named_exists(page: Path) -> None:
    named = set(re.findall(r"`make ([a-z]+)", page.read_text()))
    named |= set(re.findall(r"^make ([a-z]+)", shell_of(page), re.M))
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    assert named <= targets


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_and_flag_named_exists(page: Path) -> None:
    group = get_command(app)
    names = "|".join(COMMANDS)
    for name, rest in re.findall(rf"splatmill ({names})\b([^`\n|]*)", page.read_text()):
        command = group.get_command(None, name)  # type: ignore[attr-defined]  # a group, as app is
        if hasattr(command, "commands"):  # a group of commands
            rest = rest.removeprefix(" ")
            sub, _, rest = rest.partition(" ")
            if sub not in command.commands:
                assert not rest.strip(), f"splatmill {name} {sub}"
                continue
            command, rest = command.commands[sub], f" {rest}"
        if command.context_settings.get("ignore_unknown_options"):
            continue
        known = {flag for option in command.params for flag in [*option.opts, *option.secondary_opts]}
        unknown = set(re.findall(r"(?<=\s)--[a-z-]+", rest)) - known - {"--help"}
        assert not unknown, f"splatmill {name}"


def test_the_readme_lists_its_prerequisites_and_commands() -> None:
    text = (ROOT / "README.md").read_text()
    for needed in ("make demo", "make test", "make docs", "Python >= 3.11", "C++17"):
        assert needed in text


@pytest.mark.parametrize("name", ["ARCHITECTURE.md", "MAP.md"])
def test_the_map_is_that_of_the_modules_and_of_the_import_contracts(name: str) -> None:
    assert (ROOT / name).read_text() == COMMITTED[name](), "run: make generated"


def test_the_paths_in_the_architecture_exist() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    worker = ROOT / "worker" / "splatmill_worker"
    paths = re.findall(r"`((?:client|server|worker|tests|kernels|splat|images|sfm)/[\w/.]*)`", text)
    assert not [path for path in paths if not (ROOT / path).exists() and not (worker / path).exists()]


def test_photographing_explains_every_code_that_photos_lead_to() -> None:
    text = (ROOT / "docs" / "photographing.md").read_text()
    named = set(re.findall(r"^\| `(\w+)` \|", text, re.M))
    assert named <= set(PROBLEMS)
    assert {code for code in PROBLEMS if code.startswith("sfm_")} <= named
    assert {"no_images", "too_few_images", "poses_invalid"} <= named


def test_photographing_quotes_the_reasons_that_structure_from_motion_gives() -> None:
    text = (ROOT / "docs" / "photographing.md").read_text()
    section = text.partition("## When some photos are left out")[2].partition("## ")[0]
    quoted = [row.split("|")[1].strip() for row in re.findall(r"^\| .+ \|$", section, re.M)[2:]]
    source = "\n".join(path.read_text() for path in (ROOT / "worker" / "splatmill_worker").rglob("*.py"))
    said = re.sub(r"\{[^{}]*\}", "{}", re.sub(r'"\s*\n\s*f?"', "", source))
    assert len(quoted) == 7
    for reason in quoted:
        assert re.sub(r"\*[^*]+\*", "{}", reason) in said


def test_settings_named_in_the_guides_exist() -> None:
    names = {option.name for option in describe_options()}
    for page in (ROOT / "docs" / "photographing.md", ROOT / "docs" / "first-splat.md"):
        for name, value in re.findall(r"`([a-z_]+)=([a-z]+)`", page.read_text()):
            assert name in names
            option = next(option for option in describe_options() if option.name == name)
            assert value in (option.choices or ())


def test_the_report_page_lists_the_decisions_of_the_plan() -> None:
    text = (ROOT / "docs" / "report.md").read_text()
    section = text.partition("## What was decided")[2].partition("## ")[0]
    named = set(re.findall(r"`(\w+)`", section))
    about = {
        "kernels",
        "target_psnr",
        "max_memory",
        "stops_when_flat",
        "seed",
        "reasons",
        "left_out",
        "forced",
    }
    assert set(Plan.__dataclass_fields__) - about <= named
    assert BY_OPTION.removesuffix(".") in section


def test_the_report_page_has_the_headings_of_the_report() -> None:
    text = (ROOT / "docs" / "report.md").read_text()
    page = (ROOT / "worker" / "splatmill_worker" / "splat" / "report" / "page.py").read_text()
    headings = re.findall(r"<h2>([^<{]+)</h2>", page)
    assert len(headings) >= 5
    assert not [heading for heading in headings if heading not in text]
