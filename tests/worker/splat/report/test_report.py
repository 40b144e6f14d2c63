"""Proves the files and the warnings of a report: photos that fit badly or have no camera are named; no NaN in JSON.

Does not prove how the page looks.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatmill_worker.scene import Normalization
from splatmill_worker.splat.evaluate import Score, ViewScore
from splatmill_worker.splat.gaussians import Gaussians
from splatmill_worker.splat.plan import facts
from splatmill_worker.splat.report.export import Exported, ExportWorld
from splatmill_worker.splat.report.report import PlannedScene, plain, write_report
from splatmill_worker.splat.train.curve import CurvePoint
from splatmill_worker.splat.train.disagreement import Disagreement
from splatmill_worker.splat.train.loop import Trained
from tests.support import still_life
from tests.support.training import plan


def trained(psnrs: list[float], held_out: bool) -> Trained:
    """A result whose training views have these PSNRs."""
    views = still_life.training_views()[: len(psnrs)]
    scores = tuple(
        ViewScore(view.name, 0.01, psnr, 0.9, psnr + 2.0) for view, psnr in zip(views, psnrs, strict=True)
    )
    nothing = torch.zeros(0, 3)
    return Trained(
        gaussians=Gaussians(nothing, nothing, torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3)),
        curve=(CurvePoint(1.0, 10, math.nan, None, None, 5), CurvePoint(2.0, 20, 0.1, None, None, 5)),
        held_out=Score(scores[:1]) if held_out else None,
        on_training=Score(scores),
        steps=20,
        seconds=2.0,
        evaluate_seconds=0.5,
        stopped="the budget is spent",
        failure=None,
        recoveries=0,
        views=tuple(views),
        cameras_moved=None,
    )


def report_of(
    out: Path,
    result: Trained,
    left_out: tuple[tuple[str, str], ...] = (),
    said: dict[str, Any] | None = None,
) -> dict[str, Any]:
    scene = replace(still_life.scene(), left_out=left_out, facts=said or {})
    views = still_life.training_views()
    measured, _ = facts.measure(scene, views, 0, None)
    held_out = views[:1] if result.held_out is not None else []
    world = ExportWorld(Normalization(1.0, np.zeros(3)), np.array([100.0, 0.0, 0.0]))
    report = write_report(
        out,
        PlannedScene(scene, measured.as_dict(), plan(20), held_out),
        result,
        Exported(5, world),
        lambda target, _: torch.full((*target.rgb.shape[:2], 3), 0.5),
        seconds={"sfm": 3.0},
        warnings=["said before."],
    )
    assert json.loads((out / "report.json").read_text()) == report
    return report


def test_a_photo_far_below_the_others_is_named_with_advice(tmp_path: Path) -> None:
    report = report_of(tmp_path, trained([30.0, 29.0, 31.0, 30.5, 12.0], held_out=True))
    assert report["warnings"] == ["said before."]
    (misfit,) = report["misfits"]
    assert misfit["photo"] == "04.png"
    assert misfit["why"].startswith(
        "04.png does not fit the other photos: its PSNR is 12.0 dB, the median 30.0 dB."
    )
    assert "Leave it out" in misfit["why"]
    page = (tmp_path / "report.html").read_text()
    assert page.index("said before.") < page.index(misfit["why"])


def test_lpips_is_on_the_page_where_it_was_measured(tmp_path: Path) -> None:
    result = trained([30.0, 31.0], held_out=True)
    assert "LPIPS" not in (report_of(tmp_path, result) and (tmp_path / "report.html").read_text())
    view = replace(result.on_training.views[0], lpips_vgg=0.1234, lpips_alex=0.0567)
    report = report_of(tmp_path, replace(result, held_out=Score((view,))))
    assert (report["result"]["lpips_vgg"], report["result"]["lpips_alex"]) == (0.1234, 0.0567)
    assert [row["lpips_vgg"] for row in report["views"]] == [0.1234, None, None]
    page = (tmp_path / "report.html").read_text()
    assert "SSIM 0.900, LPIPS 0.123 by VGG-16 and 0.057 by AlexNet" in page
    assert "<th class=n>LPIPS, VGG-16</th>" in page
    assert "<td class=n>0.1234</td><td class=n>0.0567</td>" in page


def test_photos_without_a_camera_are_counted_and_named(tmp_path: Path) -> None:
    missing = tuple((f"x{i}.png", "It shares too little.") for i in range(7))
    report = report_of(tmp_path, trained([30.0], held_out=True), missing)
    named = "x0.png, x1.png, x2.png, x3.png, x4.png and 2 more"
    page = (tmp_path / "report.html").read_text()
    assert f"7 of 21 photos are not used: {named}. The report lists the reasons." in page
    assert {"photo": "x6.png", "why": "It shares too little."} in report["left_out"]


def test_of_absolute_paths_only_names_of_files_are_left(tmp_path: Path) -> None:
    """Messages of the operating system and of libraries name files by where they lie on this machine."""
    reasons = {
        "a.png": str(OSError(13, "Permission denied", "/srv/my data/jobs/7/images/day one/a.png")),
        "b.png": "cannot identify image file '/srv/data/b.png'",
        "c.png": "Check failed at /build/src/scene.cc:77: /srv/data/c.png is empty",
    }
    said = {"folder": Path("/srv/data/jobs/7"), "rate": "4 photos/s and/or 3/4, see https://example.org/a/b"}
    report = report_of(tmp_path, trained([30.0], held_out=True), tuple(reasons.items()), said)
    assert [row["why"] for row in report["left_out"] if "photo" in row] == [
        "[Errno 13] Permission denied: 'a.png'",
        "cannot identify image file 'b.png'",
        "Check failed at scene.cc:77: c.png is empty",
    ]
    assert report["sfm"] == {"folder": "7", "rate": said["rate"]}
    assert "/srv/" not in (tmp_path / "report.html").read_text()


def test_the_page_names_the_backend_and_not_the_machine(tmp_path: Path) -> None:
    report = report_of(tmp_path, trained([30.0], held_out=True))
    page = (tmp_path / "report.html").read_text()
    assert f"backend cpu, instruction set {report['versions']['instruction_set']}, " in page
    assert f"{report['machine']['cores']} cores. " in page
    assert report["machine"]["processor"] not in page
    assert set(report["machine"]) == {"processor", "cores", "memory", "gpu"}


def test_the_stages_the_offset_and_the_headline_are_those_of_the_run(tmp_path: Path) -> None:
    report = report_of(tmp_path, trained([30.0, 20.0], held_out=False))
    assert report["seconds"] == {"sfm": 3.0, "train": 2.0, "evaluate": 0.5}
    assert report["offset"] == [100.0, 0.0, 0.0]
    assert report["curve"][0]["loss"] is None
    page = (tmp_path / "report.html").read_text()
    assert "25.00 dB on training photos, none were held out; 5 Gaussians after 20 steps" in page
    assert "Training ended because the budget is spent." in page
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")


def test_light_is_told_apart_from_shape(tmp_path: Path) -> None:
    report = report_of(tmp_path, trained([30.0, 20.0], held_out=True))
    assert (report["result"]["psnr"], report["result"]["psnr_color_fitted"]) == (30.0, 32.0)
    assert report["result"]["train_psnr_color_fitted"] == 27.0
    assert [row["psnr_color_fitted"] for row in report["views"]] == [32.0, 32.0, 22.0]
    page = (tmp_path / "report.html").read_text()
    assert "30.00 dB on held-out photos (32.00 dB with colours fitted, SSIM 0.900)" in page
    assert "<td class=n>30.00</td><td class=n>32.00</td>" in page


def test_photos_that_disagree_are_ranked_with_the_reason(tmp_path: Path) -> None:
    nowhere = torch.zeros(36, 48, dtype=torch.bool)
    patch = nowhere.clone()
    patch[5:15, 10:30] = True
    disagreements = (
        Disagreement("01.png", 9.5, 0.116, "moving things", patch),
        Disagreement("02.png", 4.0, 0.0, "other light", nowhere),
        Disagreement("00.png", 0.1, 0.0, None, nowhere),
    )
    result = replace(trained([30.0, 20.0, 30.0, 30.0, 29.0], True), disagreements=disagreements)
    report = report_of(tmp_path, result)
    assert report["disagreement"][0] == {
        "photo": "01.png",
        "decibels": 9.5,
        "share": 0.116,
        "reason": "moving things",
    }
    assert len(report["disagreement"]) == 3
    assert report["misfits"][0]["why"].endswith("and mask what moved.")
    page = (tmp_path / "report.html").read_text()
    assert "<td>02.png</td><td>other light</td><td class=n>4.0</td>" in page
    assert page.count("<figcaption>01.png: moving things</figcaption>") == 1
    assert "02.png: other light" not in page


def test_photos_that_all_agree_are_said_to(tmp_path: Path) -> None:
    report_of(tmp_path, trained([30.0], held_out=True))
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Photos that disagree with the others</h2>\n<p>None does.</p>" in page


def test_json_gets_plain_values() -> None:
    assert plain({1: (math.inf, np.arange(2), True, Path("x"))}) == {"1": [None, [0, 1], True, "x"]}


def test_where_the_cameras_are_wrong_no_photo_is_accused_of_another_light(tmp_path: Path) -> None:
    disagreements = (Disagreement("02.png", 4.0, 0.0, "other light", torch.zeros(2, 2, dtype=torch.bool)),)
    result = replace(trained([30.0, 30.0, 12.0, 30.0, 29.0], True), disagreements=disagreements)
    for contradicted in (False, True):
        report = report_of(tmp_path, result, said={"cameras_contradicted": contradicted})
        (misfit,) = (each["why"] for each in report["misfits"] if each["photo"] == "02.png")
        assert ("light" in misfit) != contradicted
        assert ("other light" in (tmp_path / "report.html").read_text()) != contradicted
        assert report["disagreement"][0]["reason"] == (None if contradicted else "other light")
