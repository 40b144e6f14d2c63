"""Proves the runner of the studies: pages are made from their rows, a row replaces that of the same measurement, a dry
run writes nothing, and what is left out is reported.

Not proven here: what each study measures (the other files of this folder), and figures.
"""

from __future__ import annotations

import importlib.util
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest
from _page import END, filled
from _rows import HERE, Row, footer
from _studies.study import Study

from splatmill_worker.__main__ import main
from tests.support.paths import ROOT

STUDIES = [
    *((name, "STUDY") for name in ("stability", "worst", "functions", "stiffness")),
    *(
        (name, "STUDY")
        for name in (
            "kernels",
            "scale",
            "sfm",
            "formats",
            "mesh",
            "live",
            "gabor",
            "tiles",
            "ground",
            "workers",
        )
    ),
    ("kernels", "SIZES"),
    ("sfm", "GROWTH"),
    *((name, "STUDY") for name in ("abuse", "capacity", "fleet", "fuzz", "load", "openapi", "rq_alone")),
]


def study_of(module: str, name: str) -> Study:
    """A study of a benchmark's file. By its path: tests/kernels is a `kernels` too."""
    folders = [ROOT / part / "bench" for part in ("worker", "server")]
    places = [folder / file for folder in folders for file in (f"{module}.py", f"{module}/{module}.py")]
    path = next(path for path in places if path.exists())
    spec = importlib.util.spec_from_file_location(f"bench_{module}", path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[spec.name] = loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    study: Study = getattr(loaded, name)
    return study


@pytest.mark.parametrize(("module", "name"), STUDIES)
def test_a_page_is_made_from_its_rows(module: str, name: str) -> None:
    study = study_of(module, name)
    assert study.page(study.rows()) == (study.home / f"{study.name}.md").read_text()


@pytest.mark.parametrize("name", sorted({module for module, _ in STUDIES}))
def test_a_study_is_a_command(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["bench", name, "--help"])
    assert "--plot-only" in capsys.readouterr().out


def test_a_study_without_rows_says_so(study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    assert study.main(["--plot-only"]) == 1
    assert f"There are no rows in {study.place()}." in capsys.readouterr().err


def test_pages_name_the_constants_that_their_figures_show() -> None:
    stability, worst = (importlib.import_module(name) for name in ("stability", "worst"))
    assert f"\nLimit: {stability.LIMIT:g} units." in (HERE / "stability.md").read_text()
    page = (HERE / "worst.md").read_text()
    assert f"## What is above {worst.LIMIT:g} units" in page
    assert f"over {worst.FINAL} changes of the input" in page


def test_a_page_without_a_place_for_a_block_is_an_error() -> None:
    page = f"one\n<!-- from rows: a -->\nold\n{END}\ntwo\n"
    assert filled(page, {"a": "new"}) == page.replace("old", "new")
    for broken in (page.replace(": a", ": b"), page.replace(END, "")):
        with pytest.raises(ValueError, match="no place for 'a'"):
            filled(broken, {"a": "new"})


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "squares.md").write_text(
        f"<!-- from rows: sum -->\n{END}\n<!-- from rows: footer -->\n{END}\n"
    )

    def two(options: Namespace) -> list[Row | str]:
        return [
            {"x": 2, "square": options.power + len(options.known)},
            "The third is left out: it is not here.",
        ]

    return Study(
        name="squares",
        about=None,
        cases={"one": lambda _: [{"x": 1, "square": 1}], "two": two},
        key=("x",),
        home=tmp_path,
        blocks={"sum": lambda rows: str([row["square"] for row in rows]), "footer": footer},
        figures={},
        options={"power": {"type": int, "default": 4}},
    )


def test_a_row_replaces_that_of_the_same_measurement(study: Study, tmp_path: Path, capsys: Any) -> None:
    assert study.main([]) == 1
    assert "The third is left out" in capsys.readouterr().err
    assert study.main(["--only", "one"]) == 0
    assert study.main(["--only", "two", "--power", "7"]) == 1
    assert [row["square"] for row in study.rows()] == [1, 9]
    assert study.place().read_text().count("\n") == 2
    assert (tmp_path / "squares.md").read_text().startswith("<!-- from rows: sum -->\n[1, 9]\n")
    assert all(row["commit"] for row in study.rows())


def test_a_dry_run_writes_nothing(study: Study, tmp_path: Path, capsys: Any) -> None:
    before = (tmp_path / "squares.md").read_text()
    assert study.main(["--dry", "--only", "one"]) == 0
    assert capsys.readouterr().out == '{"x": 1, "square": 1}\n'
    assert [path.name for path in tmp_path.iterdir()] == ["squares.md"]
    assert (tmp_path / "squares.md").read_text() == before
