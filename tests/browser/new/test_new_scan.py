"""The page at `/` starts a training from a scan that is given with the photos.

Not proved here: what becomes of its points (tests/worker/pipeline/test_scan_fit.py).
"""

from __future__ import annotations

import shutil
from pathlib import Path

from playwright.sync_api import expect

from tests.browser.conftest import Visit
from tests.browser.new.test_new import digest, files_of, give, opened, started
from tests.browser.new.test_new import jobs as jobs
from tests.support.up import Up


def test_a_scan_beside_the_photos_is_what_the_training_starts_from(
    visit: Visit, service: Up, photos: Path, tmp_path: Path, jobs: None
) -> None:
    folder = tmp_path / "with a scan"
    shutil.copytree(photos, folder)
    for name in ("Scan A.xyz", "scan b.PTS"):
        (folder / name).write_text("0 0 0 255 0 0\n0 0 1 0 255 0\n")
    page = opened(visit.page)
    give(page, folder)
    row = page.locator(".file").filter(has_text="Scan A.xyz (points to start from")
    expect(row).to_have_count(1)
    remarks = page.locator("#remarks")
    expect(remarks).to_contain_text("The training starts from the points of Scan A.xyz")
    expect(remarks).to_contain_text("One file of points is used. These are not: scan b.PTS.")
    row.get_by_role("button", name="Leave out").click()
    expect(remarks).not_to_contain_text("starts from the points")
    row.get_by_role("button", name="Use Scan A.xyz").click()
    page.get_by_role("button", name="Upload and train").click()
    job = started(page, service)
    assert job["options"]["start"] == "Scan A.xyz"
    assert files_of(service, job["capture"])["poses/Scan A.xyz"] == digest(folder / "Scan A.xyz")
