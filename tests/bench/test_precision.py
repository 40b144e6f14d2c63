"""Proves `bench precision`: that the storage formats round as they say, in C++ as in torch, that the definitions of a
variant reach the kernels, and a small run from timing to report.

Not proven here: the builds of the variants, which take minutes to compile, and the figures.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
from pathlib import Path

import _scenes
import pytest
import torch
from _studies.precision import formats
from _studies.precision.builds import _held, using
from _studies.precision.variants import BY_NAME, PLAIN, STORAGE, VARIANTS, Variant

from splatmill_worker.kernels.cpu import engine, isa
from splatmill_worker.kernels.cpu.step import Step
from tests.support import still_life
from tests.support.paths import ROOT

bench = importlib.import_module("precision")
KERNELS = ROOT / "worker/splatmill_worker/kernels/cpu"
NARROW = [name for name in formats.BYTES if name != "Float32"]

PROGRAM = """
#define SPLATMILL_STORAGE "%s"
#define SPLATMILL_HARMONICS Float32
#define SPLATMILL_FIRST_MOMENT Float32
#define SPLATMILL_SECOND_MOMENT Float32
#include <cstdio>
#include "layout/storage.hpp"
using namespace splatmill;
template <class Format>
void round_trip(const float* values, int rows) {
  alignas(64) float wide[kLanes];
  alignas(64) char narrow[4 * kLanes];
  for (int b = 0; b < rows; ++b) {
    Noise noise(7, b);
    Format::store(narrow, load(values + b * kLanes), noise);
    store(wide, Format::load(narrow));
    fwrite(narrow, 1, Format::kBytes * kLanes, stdout);
    fwrite(wide, 4, kLanes, stdout);
  }
}
int main() {
  alignas(64) static float values[1 << 16];
  const int rows = static_cast<int>(fread(values, 4, 1 << 16, stdin)) / kLanes;
%s
}
"""


AVX2 = ["-mavx2", "-mfma", "-mf16c"]
AVX512 = [*AVX2, "-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl"]
FLAGS = {"baseline": [], "avx2": AVX2, "avx512": AVX512}


def round_trips(
    values: torch.Tensor, folder: Path, build: str
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """For each format the bytes [n, 16 BYTES] and the values [n, 16] that C++ makes of rows [n, 16]."""
    calls = "\n".join(f"  round_trip<{name}>(values, rows);" for name in NARROW)
    (folder / "formats.cpp").write_text(PROGRAM % (STORAGE, calls))
    command = [
        os.environ.get("CXX", "c++"),
        "-std=gnu++17",
        "-O0",
        "-w",
        "-I",
        KERNELS,
        "formats.cpp",
        "-o",
        "formats",
    ]
    subprocess.run(command, cwd=folder, check=True)
    raw = values.numpy().tobytes()
    out = subprocess.run([folder / "formats"], input=raw, capture_output=True, check=True).stdout
    found, at = {}, 0
    for name in NARROW:
        row = 16 * (formats.BYTES[name] + 4)
        part = torch.frombuffer(bytearray(out[at : at + row * len(values)]), dtype=torch.uint8).view(-1, row)
        at += row * len(values)
        narrow = part[:, : 16 * formats.BYTES[name]]
        found[name] = narrow, part[:, 16 * formats.BYTES[name] :].contiguous().view(torch.float32)
    assert at == len(out)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("build", isa.supported())
def test_formats_round_as_they_say(tmp_path: Path, build: str) -> None:
    generator = torch.Generator().manual_seed(0)
    sizes = torch.exp(torch.linspace(-9, 9, 2048))[:, None]  # the normal numbers of binary16
    values = (
        torch.randn(2048, 16, generator=generator).sign() * torch.rand(2048, 16, generator=generator) * sizes
    )
    values = torch.where(values.abs() < 1e-4, values.sign() * 1e-4, values)
    units = {
        "BFloat16": 2.0**-7,
        "BFloat16Compensated": 2.0**-15,
        "Float16": 2.0**-10,
    }  # spacing over value, at most
    for name, (narrow, wide) in round_trips(values, tmp_path, build).items():
        unit = units[name.removesuffix("Stochastic")]
        error = (wide.double() - values.double()) / values.double()
        assert torch.equal(formats.widened(narrow, name), wide)
        if not name.endswith("Stochastic"):
            assert torch.equal(formats.narrowed(values, name), narrow)
            assert error.abs().max() <= unit / 2
        else:
            assert error.abs().max() < unit
            assert error.abs().max() > unit / 2  # some are rounded to the farther neighbour
            # The mean of 2^15 errors of a standard deviation of at most half a unit: 5 sigma.
            assert abs(error.mean()) < 5 * (unit / 2) / 2**7.5


def test_blocks_are_what_they_were_after_a_round_trip() -> None:
    generator = torch.Generator().manual_seed(0)
    blocks = torch.randn(3, 59, 16, generator=generator)
    for name in NARROW:
        narrow = formats.Narrow(name, 11)
        once = narrow.restored(narrow.stored(blocks))
        assert torch.equal(once[:, :11], blocks[:, :11])
        assert (once - blocks).abs().max() <= 2**-8 * blocks.abs().max()
        assert torch.equal(narrow.restored(narrow.stored(once)), once)


def test_a_step_gives_wide_values_of_what_it_holds_narrow() -> None:
    """With kernels that are not asked to compute: packing, unpacking and moments."""
    groups = [x[:40] for x in _scenes.cloud(50, 16, 16).groups]
    variant = Variant("all", "moments", "", ("step",), "BFloat16", "BFloat16", "BFloat16Compensated")
    moments = torch.rand(40, 59), torch.rand(40, 59)
    with using(variant, engine):
        step = Step(*groups)
        step.replace(step.parameters(), *moments)
        assert step.blocks.view(torch.uint8).view(-1)[3 * (11 * 64 + 48 * 32) :].count_nonzero() == 0
        assert torch.equal(step.parameters()["means"], groups[0])
        assert torch.equal(step.parameters()["sh"], groups[4].bfloat16().float())
        assert torch.equal(step.moments()[0], moments[0].bfloat16().float())
        assert torch.allclose(step.moments()[1], moments[1], rtol=2**-16, atol=0)
    assert Step(*groups).moments()[0].count_nonzero() == 0


def test_the_definitions_of_every_variant_reach_the_kernels() -> None:
    source = "".join(p.read_text() for p in (KERNELS / "layout/storage.hpp", STORAGE))
    for variant in BY_NAME.values():
        assert set(variant.sources) <= {path.stem for path in KERNELS.rglob("*.cpp")}
        assert bool(variant.definitions) == (variant is not PLAIN)
        for definition in variant.definitions:
            name, value = definition.split("=", 1)
            assert re.search(rf"\b{name}\b", source)
            if re.fullmatch(r"B?Float\d+\w*", value):
                assert re.search(rf"struct {value}\b", source)
    for variant in VARIANTS:
        assert all(narrow.format in formats.BYTES for narrow in _held(variant).values())


@pytest.mark.slow
def test_a_small_run_measures_and_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the shipped engine, which also stands for the exact one: no error, time of its own, moments that fall."""
    still_life.posed_capture(tmp_path / "tiny")
    monkeypatch.setattr(bench, "COUNTS", (300,))
    monkeypatch.setattr(bench, "AFTER", (1, 300))
    monkeypatch.setattr(bench._scenes, "fox", lambda *_: None)
    monkeypatch.setattr(bench, "VARIANTS", [PLAIN])
    monkeypatch.setattr(bench, "compiled", lambda variants, _: {v.name: engine for v in variants})
    files = ["--work", str(tmp_path), "--out", str(tmp_path), "--scenes", str(tmp_path / "tiny")]
    small = [
        "--steps",
        "20",
        "--size",
        "48",
        "--seeds",
        "1",
        "--rounds",
        "2",
        "--views",
        "1",
        "--threads",
        "1",
    ]
    assert bench.STUDY.main([*files, *small]) == 0
    rows = bench.STUDY.rows(tmp_path)
    for row in rows:
        if row["kind"] == "decay":
            assert row["share"] == pytest.approx(row["exact"], rel=1e-4)
            assert row["unmoved"] == 0
        if row["kind"] == "error":
            assert row["image"] == 0
            assert set(row["gradient"].values()) == {0.0}
        if row["kind"] == "time":
            assert row["cpu_ratio"] == 1
            assert row["update_ms"] < row["wall_ms"]
    assert [r["kind"] for r in rows if r["kind"] != "decay"] == ["error", "time", "training"]
    assert rows[-1]["outcome"] == "trained"
    assert rows[-1]["steps"] == 20
    assert bench.STUDY.main([*files, *small, "--only", "training"]) == 0
    assert bench.STUDY.rows(tmp_path) == rows, "a training that has a row is not repeated"
    assert (tmp_path / "figures" / "precision.png").stat().st_size > 10_000
    assert "| float32, dB |" in (tmp_path / "precision.md").read_text()
