"""Proves `bench functions`: what it counts, that no float is left out, and its quick form.

Not proven here: that the functions are as exact as the table says (tests/kernels/test_functions.py).
"""

from __future__ import annotations

import importlib
from itertools import pairwise
from pathlib import Path

import pytest
from _studies.functions.library import errors, load, measure
from _studies.functions.spans import FUNCTIONS, NEAR_0, Function, bits_at, place, runs, value
from _studies.functions.tolerances import ALPHA_ERROR, EXP2_ERROR

from splatmill_worker.kernels.cpu import isa
from tests.support.paths import ROOT

bench = importlib.import_module("functions")


@pytest.mark.slow
def test_what_is_counted_is_right() -> None:
    """A correctly rounded function has errors of up to half an ulp, no more, and just so; 1/sqrt x is not sqrt x."""
    (function,) = [f for f in FUNCTIONS if f.name == "sqrt"]
    row = measure("baseline", function)
    assert row["count"] == 2**24
    assert row["unlike"] == 0
    # The power of 2 is looked at: by that of 1/sqrt x, only the octaves themselves agree.
    assert load("baseline").unlike_octaves(b"sqrt", 0, 2, -1) == 2 * 2**24
    assert row["rounded"] == 1
    assert 0.4999 < row["ulp"] <= 0.5
    # Errors of rounding are spread evenly over an ulp: 1/sqrt 12 of it in the root mean square.
    assert row["rms_ulp"] == pytest.approx(12**-0.5, rel=1e-3)
    assert row["absolute"] == pytest.approx(2.0**-24, rel=1e-3)
    with pytest.raises(ValueError, match="no function 'sine'"):
        errors(load("baseline"), "sine", [(0, 1)])


@pytest.mark.slow
def test_the_quick_form_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        bench.STUDY.main(["--stride", "1000003", "--dry", "--only", *isa.ISAS, "--out", str(tmp_path)]) == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(FUNCTIONS) * len(isa.supported()) + len(isa.ISAS) - len(isa.supported())
    assert not list(tmp_path.iterdir())


def test_a_part_of_the_floats_is_not_stored() -> None:
    with pytest.raises(SystemExit, match="--dry"):
        bench.STUDY.main(["--stride", "1000003"])


def test_every_float_has_one_place() -> None:
    for x in (0.0, -0.0, 1.0, -1.5, 2.0**127, -(2.0**-149)):
        assert value(place(x)) == x
    assert place(-0.0) == -1
    assert bits_at(place(-0.0)) == 1 << 31
    for stride in (1, 2, 3, 7):
        for first, end in ((-10, 12), (-9, -2), (4, 30), (-1, 1), (5, 5)):
            bits = [low + i * stride for low, count in runs(first, end, stride) for i in range(count)]
            assert sorted(bits) == sorted(bits_at(at) for at in range(first, end, stride))


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.name)
def test_parts_are_the_whole_span(function: Function) -> None:
    parts = function.span.parts(256)
    edges = [edge for low, high in function.span.intervals for edge in (place(low), place(high) + 1)]
    assert parts[0][0] == edges[0]
    assert parts[-1][1] == edges[-1]
    jumps = [(a[1], b[0]) for a, b in pairwise(parts) if a[1] != b[0]]
    assert [edge for jump in jumps for edge in jump] == edges[1:-1]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.name)
def test_the_rows_are_of_every_float(function: Function) -> None:
    rows = [row for row in bench.STUDY.rows() if row["function"] == function.name and "arguments" in row]
    assert {"avx2", "baseline"} <= {row["build"] for row in rows}
    for row in rows:
        assert row["count"] == function.span.count
        assert row["arguments"] == function.span.label
        if function.octaves is not None:
            assert row["octaves"] == function.octaves.label
            assert row["unlike"] == 0


def test_the_comparison_is_exact_enough() -> None:
    rows = [row for row in bench.STUDY.rows() if "samples" in row]
    assert [row["function"] for row in rows] == [function.name for function in FUNCTIONS]
    assert all(row["samples"] > 1000 and row["ulp"] < 1e-8 for row in rows)


def test_the_page_of_the_documentation_is_made_from_rows() -> None:
    rows = bench.STUDY.rows()
    page = (ROOT / "docs" / "programming" / "precision.md").read_text()
    assert "\n".join(bench.summary(rows)) in page
    assert f"{1e6 * EXP2_ERROR:.1f}·10⁻⁶ of {1e6 * ALPHA_ERROR:.1f}·10⁻⁶" in page


@pytest.mark.slow
@pytest.mark.parametrize("build", isa.supported())
@pytest.mark.parametrize(("name", "at_0"), [("exp", 1.0), ("exp2_of_alpha", 0.9999992847442627)])
def test_what_is_left_out_near_0_has_one_result(name: str, at_0: float, build: str) -> None:
    """The error is then that of the result at 0, but for the distance from 1 of the exact value."""
    ends = (place(-NEAR_0), place(NEAR_0) + 1)
    totals = errors(load(build), name, [ends], stride=100_003)
    assert totals.count > 10_000
    assert totals.absolute == pytest.approx(1 - at_0, abs=1.01 * NEAR_0)
