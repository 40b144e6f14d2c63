"""Proves that a file says whether its model is drawn antialiased, without a report, and that all that draws, converts
or edits it follows what the file says.

Does not prove that other programs follow it: their spellings are read here from files made by hand.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage
from splatmill.schema import CameraSpec, EditModel
from splatmill.schema.files.formats import MODEL_FORMATS
from splatmill_worker.render_service.clean import CleanSettings, clean_file
from splatmill_worker.render_service.convert import convert
from splatmill_worker.render_service.edit import edit
from splatmill_worker.render_service.encoding import camera_of, render_frame
from splatmill_worker.render_service.local import loaded, read
from splatmill_worker.render_service.model_cache import ModelCache
from splatmill_worker.splat.formats import compressed_ply, ply, registry
from splatmill_worker.splat.render import render
from splatmill_worker.splat.start import given_file
from tests.support.ball import BALL, store_ball
from tests.support.gaussians import some_gaussians

WRITTEN = [suffix for suffix, form in MODEL_FORMATS.items() if form.writable and form.readable]
BOX = EditModel.model_validate({"box": {"min": [-9, -9, -9], "max": [9, 9, 9]}})


def with_comments(path: Path, *comments: str) -> Path:
    """The file with these comments only."""
    document = PlyData.read(str(path), mmap=False)
    document.comments = list(comments)
    document.write(str(path))
    return path


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("suffix", WRITTEN)
def test_every_format_that_is_written_says_it(tmp_path: Path, suffix: str, antialiased: bool) -> None:
    path = tmp_path / (f"m{suffix}" if suffix.startswith(".") else suffix)
    registry.write(path, some_gaussians(20, 1), antialiased=antialiased)
    assert registry.read(path).antialiased is antialiased
    assert given_file.read(path, 10)["antialiased"] is antialiased


@pytest.mark.parametrize(
    ("comments", "says"),
    [
        ((), None),
        (("made by hand", "Vertical axis: y"), None),
        (("SplatRenderMode: mip",), True),
        (("splatrendermode:MIP ",), True),
        (("SplatRenderMode: default",), False),
        (("SplatRenderMode: 2dgs",), False),
        (("postshot.anti_aliasing=1",), True),
        (("postshot.anti_aliasing=0",), False),
        (("antialiased 1",), True),
        (("antialiased 1", "SplatRenderMode: default"), False),
        (("SplatRenderMode: default", "postshot.anti_aliasing=1"), True),
    ],
)
def test_the_comments_of_other_programs_are_read(
    tmp_path: Path, comments: tuple[str, ...], says: bool | None
) -> None:
    ply.write(tmp_path / "a.ply", some_gaussians(20, 1))
    compressed_ply.write(tmp_path / "b.ply", some_gaussians(20, 1))
    for name in "ab":
        assert registry.read(with_comments(tmp_path / f"{name}.ply", *comments)).antialiased is says


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"model": "antialiased"}, True),
        ({"model": "2dgs"}, False),
        ({"antialias": True}, True),
        ({"antialias": True, "model": "default"}, False),
        ({"antialias": True, "model": ["antialiased"]}, True),
        ({}, None),
    ],
)
def test_the_fields_of_other_writers_of_sog_are_read(
    tmp_path: Path, fields: dict[str, object], says: bool | None
) -> None:
    registry.write(tmp_path / "m.sog", some_gaussians(20, 1))
    with zipfile.ZipFile(tmp_path / "m.sog") as archive:
        archive.extractall(tmp_path)
    meta = json.loads((tmp_path / "meta.json").read_text())
    del meta["antialias"], meta["model"]
    (tmp_path / "meta.json").write_text(json.dumps(meta | fields))
    assert registry.read(tmp_path / "meta.json").antialiased is says


def test_a_file_alone_is_drawn_converted_and_cleaned_as_it_says(tmp_path: Path) -> None:
    scene = some_gaussians(300, 0)
    scene = replace(scene, log_scales=scene.log_scales - 3)  # small ones, which the filter changes
    ply.write(tmp_path / "other.ply", scene)
    model = with_comments(tmp_path / "other.ply", "SplatRenderMode: mip")
    camera = CameraSpec.looking_at((6, 0, 0), (0, 0, 0), width=48, height=32)
    right, wrong = (
        render(ply.read(model).gaussians, camera_of(camera), background=(0, 0, 0), antialias=antialias).color
        for antialias in (True, False)
    )
    assert float((right - wrong).abs().max()) > 0.1
    with loaded(model) as drawn:
        picture = torch.from_numpy(render_frame(drawn, camera_of(camera), "black")) / 255
    assert float((picture - right.clamp(0, 1)).abs().max()) < 0.01
    outs = [tmp_path / (f"out{suffix}" if suffix.startswith(".") else suffix) for suffix in WRITTEN]
    convert(model, outs, None)
    clean_file(model, tmp_path / "cleaned.ply", CleanSettings(edit=BOX))
    assert all(read(out).antialiased for out in [*outs, tmp_path / "cleaned.ply"])


def test_a_stored_model_without_a_report_is_drawn_and_edited_as_its_file_says(tmp_path: Path) -> None:
    storage = Storage((tmp_path / "storage").as_uri())
    store_ball(storage, tmp_path)
    report = json.dumps({"plan": {"antialias": False}}).encode()
    assert not ModelCache(storage, 10**6).get(BALL).antialias
    model = with_comments(tmp_path / "model.ply", "SplatRenderMode: mip")
    storage.put(layout.model_file(BALL, "model.ply"), model)
    for kept in (None, report):
        if kept is not None:
            storage.put(layout.model_file(BALL, "report.json"), kept)
        assert ModelCache(storage, 10**6).get(BALL).antialias
        edit(storage, BALL, BOX, None, tmp_path / "edited.ply")
        assert ply.read(tmp_path / "edited.ply").antialiased is True
