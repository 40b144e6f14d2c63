"""The README's table of what the service survives is that of the rows; each bench's line says what its rows say."""

import importlib
import json
from pathlib import Path
from typing import Any

import pytest
import summary
from _page import filled

ORIGIN = {"machine": "one", "versions": {"python": "3"}, "commit": "abc"}
SOAK: list[dict[str, Any]] = [
    {"storage": "s3", "fault": "Redis killed", "resumes": 7.4, "kills": True},
    {
        "storage": "s3",
        "fault": None,
        "faults": 1,
        "killed": 1,
        "jobs": 3,
        "complaints": [],
        "kinds": {"SfM and training of 11 photos": 2, "training of 11 photos with given cameras": 1},
    },
]


def write(folder: Path, name: str, *rows: dict[str, object]) -> None:
    (folder / f"{name}.jsonl").write_text("".join(json.dumps({**row, **ORIGIN}) + "\n" for row in rows))


def test_the_readme_has_the_newest_rows() -> None:
    text = summary.README.read_text()
    assert filled(text, {"summary": summary.table()}) == text, "run `splatmill bench summary`"


def test_benches_without_rows_have_no_line(tmp_path: Path) -> None:
    assert summary.table(tmp_path).count("\n| ") == 0


def test_what_did_not_hold_is_told(tmp_path: Path) -> None:
    write(tmp_path, "soak", *SOAK)
    held = (
        "| 1 faults, 1 of them kills (Redis 1), while 3 jobs of the engine ran: 2 with SfM and training of 11 photos, "
        "1 with training of 11 photos with given cameras; storage in S3 | nothing lost, run twice or left over, and no "
        "job failed of a fault; jobs went on within 7 s"
    )
    assert held in summary.table(tmp_path)
    write(tmp_path, "soak", SOAK[0], SOAK[1] | {"complaints": ["job 1 is lost", "a file is half written"]})
    assert "**2 things did not hold**; jobs went on within 7 s" in summary.table(tmp_path)


def test_the_newest_row_counts(tmp_path: Path) -> None:
    row = {"parser": "zip", "inputs": 10, "fault": "it ended with status -11"}
    write(tmp_path, "fuzz", row, {"parser": "EXIF", "inputs": 5, "fault": ""})
    assert "| 15 changed files for 2 parsers | 1 crashed" in summary.table(tmp_path)
    write(tmp_path, "fuzz", row, row | {"inputs": 30, "fault": ""})
    assert "| 30 changed files for 1 parsers | 0 crashed" in summary.table(tmp_path)


@pytest.mark.parametrize("bench", ["soak", "train", "gpu"])
def test_a_folder_in_place_of_the_file_of_rows_is_refused_before_anything_is_measured(
    bench: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = importlib.import_module(bench)
    with pytest.raises(SystemExit):
        module.main(["--out" if bench == "gpu" else "--results", str(tmp_path)])
    assert f"{tmp_path} is a folder. Name a file for the rows" in capsys.readouterr().err
