"""The documentation builds without a warning, links between pages included, and loads nothing from other servers.

Does not prove that links to other sites lead somewhere: the tests need no network.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from docs.generate import PAGES

from splatmill.schema import PROBLEMS, describe_options
from tests.support.documentation.markdown import FOLDERS, GUIDES
from tests.support.paths import ROOT

ASSETS = re.compile(r'<(?:script|img|source|iframe)\b[^>]*\ssrc="([^"]+)"|<link\b[^>]*\shref="([^"]+)"')
STYLED = re.compile(r"url\(\s*[\"']?(https?:)?//|@import\s+[\"'](https?:)?//")


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    # The answers to hostile inputs are those that tests/hostile expects: that it gives each of them is proven there.
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "--fail-on-warning",
        "--keep-going",
        "--quiet",
        "-t",
        "expected",
    ]
    places = ["-d", str(folder / "doctrees"), str(ROOT / "docs"), str(folder / "html")]
    done = subprocess.run([*command, *places], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "html"


def test_every_page_is_there(site: Path) -> None:
    built = {
        page.relative_to(site).with_suffix("")
        for folder in FOLDERS
        for page in (site / folder).glob("*.html")
    }
    assert {page.relative_to(ROOT / "docs").with_suffix("") for page in GUIDES} == built - {
        Path(name) for name in ("genindex", "search", "py-modindex")
    }
    for name in set(PAGES) - {"python-errors.md", "formats.md"}:
        assert (site / "generated" / name).with_suffix(".html").is_file()


def test_no_page_loads_anything_from_another_server(site: Path) -> None:
    for page in site.rglob("*.html"):
        for groups in ASSETS.findall(page.read_text()):
            asset = "".join(groups)
            assert not re.match(r"(https?:)?//", asset), f"{page.name} loads {asset}"
    for sheet in site.rglob("*.css"):
        assert not STYLED.search(sheet.read_text()), sheet.name


def test_generated_pages_hold_every_setting_and_code(site: Path) -> None:
    settings = (ROOT / "docs" / "generated" / "settings.md").read_text()
    codes = (ROOT / "docs" / "generated" / "errors.md").read_text()
    assert all(f"| `{option.name}` |" in settings for option in describe_options())
    assert all(f"| `{code}` |" in codes for code in PROBLEMS)


def test_pictures_are_small() -> None:
    pictures = [path for path in (ROOT / "docs" / "pictures").iterdir() if path.suffix in (".png", ".jpg")]
    assert pictures
    assert all(path.stat().st_size < 200_000 for path in pictures)
