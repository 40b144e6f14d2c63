"""The page at `/`: files are sorted and judged, sent and sent on after breaks, and become one job.

The photos are those of the still life. Not proved here: the training of the jobs (they are cancelled), decoding in
other browsers, and a phone's own camera dialogue.
"""

from __future__ import annotations

import hashlib
import json
import random
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image, ImageFilter
from playwright.sync_api import Locator, Page, Request, Route, expect

from splatmill.schema import MIN_PHOTOS, describe_options
from splatmill_worker.images.panoramas.panoramas import by_edges, stated
from splatmill_worker.images.prepare import prepare
from tests.browser.conftest import Open, SmallModel, Visit
from tests.support import still_life
from tests.support.panoramas import gpano, striped
from tests.support.programs import npm_package
from tests.support.up import Up

CHECKED = 60_000
"""Milliseconds that the photos of a test may take to be checked on a busy machine."""


@pytest.fixture
def jobs(service: Up) -> Iterator[None]:
    """Cancel and delete what the test has started."""
    before = {job["id"] for job in service.http.get("/v1/jobs").json()["jobs"]}
    yield
    for job in service.http.get("/v1/jobs").json()["jobs"]:
        if job["id"] not in before:
            service.http.post(f"/v1/jobs/{job['id']}/cancel")
            service.ended(job["id"])


def opened(page: Page, path: str = "/") -> Page:
    page.goto(path)
    page.locator("html[data-ready]").wait_for()
    return page


def give(page: Page, *paths: Path) -> None:
    """Give a folder or files and wait until they have been checked."""
    if paths[0].is_dir():
        page.set_input_files("#folder", paths[0])
    else:
        page.set_input_files("#files", list(paths))
    expect(page.locator("#given")).to_be_visible()
    expect(page.locator("#summary")).not_to_contain_text("being checked", timeout=CHECKED)


def tile(page: Page, name: str) -> Locator:
    return page.locator(".photo").filter(has=page.get_by_text(name, exact=True))


def started(page: Page, service: Up) -> Any:
    """The job whose page has come."""
    page.wait_for_url(re.compile("/jobs/[0-9a-f]+$"), timeout=CHECKED)
    return service.job(page.url.rsplit("/", 1)[-1])


def files_of(service: Up, capture: str) -> dict[str, str]:
    files = service.http.get(f"/v1/captures/{capture}").json()["files"]
    return {f"{file['role']}/{file['name']}": file["sha256"] for file in files}


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_each_photo_gets_a_verdict_and_those_advised_against_are_left_out_at_once(
    visit: Visit, service: Up, photos: Path, tmp_path: Path, jobs: None
) -> None:
    for path in photos.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    names = sorted(path.name for path in photos.iterdir())
    picture = Image.open(photos / names[3])
    picture.filter(ImageFilter.GaussianBlur(6)).save(tmp_path / names[3], quality=95)
    picture.point(lambda level: level * 0.08).save(tmp_path / "night.png")
    picture.resize((14, 10)).save(tmp_path / "stamp.png")
    (tmp_path / "twin.jpg").write_bytes((photos / names[5]).read_bytes())
    Image.open(photos / names[7]).save(tmp_path / "still_07_again.jpg", quality=60)
    (tmp_path / "cut.jpg").write_bytes((photos / names[0]).read_bytes()[:300])
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(2000))
    (tmp_path / "notes.txt").write_text("of the walk")

    page = opened(visit.page)
    give(page, tmp_path)
    bad = {
        names[3]: "Blurred",
        "night.png": "Too dark",
        "stamp.png": "Too small: 14 × 10",
        "twin.jpg": f"The same file as {names[5]}",
        "cut.jpg": "damaged",
    }
    for name, text in bad.items():
        expect(tile(page, name)).to_have_attribute("data-verdict", "bad")
        expect(tile(page, name).locator(".verdict")).to_contain_text(text)
    expect(tile(page, "still_07_again.jpg").locator(".verdict")).to_have_text(
        "Almost the same view as still_07.jpg."
    )
    expect(tile(page, "phone.heic").locator(".verdict")).to_contain_text("The server checks it")
    good = page.locator('.photo[data-verdict="good"]')
    expect(good).to_have_count(len(names) - 1)
    assert good.locator("img").count() == len(names) - 1
    expect(page.get_by_text("notes.txt (not used")).to_be_visible()

    page.get_by_role("button", name="Leave out all 5").click()
    expect(page.locator('.photo[data-verdict="left"]')).to_have_count(5)
    page.get_by_role("button", name="Use twin.jpg").click()
    page.get_by_label("Name").fill("mixed")
    page.get_by_role("button", name="Upload and train").click()
    job = started(page, service)
    assert job["name"] == "mixed"
    expected = {*names, "twin.jpg", "still_07_again.jpg", "phone.heic"} - {names[3]}
    assert set(files_of(service, job["capture"])) == {f"images/{name}" for name in expected}


def test_photos_of_one_kind_are_not_told_apart(page: Page, photos: Path, tmp_path: Path) -> None:
    # All are blurred, and all are bright: that is the scene, not a mistake of one of them.
    for path in photos.iterdir():
        Image.open(path).filter(ImageFilter.GaussianBlur(6)).point(lambda level: 242 + level / 20).save(
            tmp_path / path.name
        )
    opened(page)
    give(page, tmp_path)
    expect(page.locator('.photo[data-verdict="bad"]')).to_have_count(0)


def test_a_panorama_is_known_before_the_upload(page: Page, photos: Path, tmp_path: Path) -> None:
    folder = tmp_path / "given"
    of_all = {"ProjectionType": "equirectangular"}
    part = of_all | {
        f"{name}HeightPixels": size for name, size in (("CroppedAreaImage", 115), ("FullPano", 256))
    }
    striped(folder / "stated.jpg", gpano(**of_all), seed=1)
    striped(folder / "edges.jpg", seed=3)
    striped(folder / "part.jpg", gpano(**part), seed=5)
    striped(folder / "cylinder.jpg", gpano(ProjectionType="cylindrical"), seed=7)
    first = sorted(photos.iterdir())[0]
    Image.open(first).resize((512, 256)).save(folder / "wide.jpg")
    # The worker decides alike.
    reasons = {}
    for path in folder.iterdir():
        with Image.open(path) as image:
            reasons[path.stem] = stated(image) or by_edges(image)
    assert (reasons["stated"], reasons["edges"], reasons["wide"]) == ("stated", "closed", "")
    give(opened(page), folder)
    for name in ("stated", "edges"):
        verdict = tile(page, f"{name}.jpg").locator(".verdict")
        expect(verdict).to_have_text("360-degree photo: it is cut into six views.")
    expect(tile(page, "wide.jpg")).not_to_contain_text("360")
    for name, words in (
        ("part", "100% of its width and 45% of its height"),
        ("cylinder", "cylindrical by its"),
    ):
        assert words in reasons[name]
        expect(tile(page, f"{name}.jpg").locator(".verdict")).to_contain_text(words)
        expect(tile(page, f"{name}.jpg")).to_have_attribute("data-verdict", "bad")


def test_what_the_job_would_warn_of_is_said_before_the_upload(
    page: Page, photos: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "given/scene"
    (scene / "masks").mkdir(parents=True)
    (scene / "images").mkdir()
    for path in sorted(photos.iterdir())[:4]:
        shutil.copy(path, scene / "images")
        mask = Image.new("L", (64, 48), 0)
        mask.paste(255, (0, 0, 16, 48))
        mask.save(scene / "masks" / f"{path.stem}.png")
    mask.save(scene / "masks/other.png")
    (scene / "transforms.json").write_text("{}")
    for name in ("model.ply", "report.json", "preview.jpg", "IMG_1.dng"):
        (tmp_path / "given" / name).write_bytes(b"x")
    opened(page)
    give(page, tmp_path / "given")
    remarks = page.locator("#remarks li")
    worker = prepare(scene / "images", scene / "masks", tmp_path / "work").warnings
    expect(remarks).to_have_text(
        [
            "The cameras are those in scene/.",
            "Results of an earlier training, not read: preview.jpg.",
            "Not read are raw photos: IMG_1.dng. Develop them as JPEG or TIFF, all with the same settings.",
            *worker,
        ],
        timeout=CHECKED,
    )
    assert [part in sentence for part, sentence in zip(("other.png", "hide 75%"), worker, strict=True)] == [
        True
    ] * 2


def test_two_data_sets_are_refused_before_the_upload(page: Page, photos: Path, tmp_path: Path) -> None:
    for name in ("chair", "table"):
        (tmp_path / "given" / name).mkdir(parents=True)
        shutil.copy(sorted(photos.iterdir())[0], tmp_path / "given" / name / f"{name}.jpg")
        (tmp_path / "given" / name / "transforms.json").write_text("{}")
    opened(page)
    give(page, tmp_path / "given")
    expect(page.locator("#remarks")).to_contain_text("several data sets, in chair/ and in table/")


def test_a_folder_with_cameras_is_dropped(visit: Visit, service: Up, tmp_path: Path, jobs: None) -> None:
    made = still_life.posed_capture(tmp_path / "made")
    data_set = tmp_path / "still life"
    data_set.mkdir()
    (made / "images").rename(data_set / "images")
    (made / "poses" / "transforms.json").rename(data_set / "transforms.json")
    page = opened(visit.page)
    session = visit.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        data = {"items": [], "files": [str(data_set)], "dragOperationsMask": 1}
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 400, "y": 300, "data": data})
    expect(page.locator("#summary")).to_contain_text("14 photos")
    expect(page.get_by_text("transforms.json (cameras")).to_be_visible()
    page.get_by_role("button", name="Upload and train").click()
    files = files_of(service, started(page, service)["capture"])
    assert files["poses/transforms.json"] == digest(data_set / "transforms.json")
    assert files["images/00.png"] == digest(data_set / "images" / "00.png")
    assert len(files) == 15


def test_what_is_dropped_before_the_page_is_ready_is_taken(visit: Visit) -> None:
    held: list[Route] = []
    visit.page.route("**/v1/me", lambda route: held.append(route))
    visit.page.goto("/")
    cancelled = visit.page.evaluate("""() => {
        const data = new DataTransfer();
        data.items.add(new File(["hello"], "notes.txt"));
        return !document.body.dispatchEvent(
            new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
    }""")
    assert cancelled  # or the browser would leave the page for the file
    held[0].continue_()
    expect(visit.page.locator("#main")).to_contain_text("notes.txt")


def test_a_killed_upload_sends_what_is_missing(visit: Visit, service: Up, tmp_path: Path, jobs: None) -> None:
    noise = random.Random(1)
    for number in range(9):
        (tmp_path / f"{number}.jpg").write_bytes(noise.randbytes(60_000))
    visit.watched.allow("Failed to load resource")
    page = opened(visit.page)
    give(page, tmp_path)
    page.locator("#name").fill("twice")
    page.locator("#option-time_budget").fill("7s")
    slow(visit, page, 100_000)
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#sent-text")).to_contain_text(re.compile("[4-8] of 9 files"), timeout=CHECKED)
    page.close(run_before_unload=False)

    again = opened(visit.context.new_page())
    expect(again.locator("#go-on")).to_contain_text(re.compile("twice, [4-8] of 9 files arrived"))
    sent: list[str] = []

    def note(request: Request) -> None:
        if request.method == "PUT":
            sent.append(request.url)

    again.on("request", note)
    give(again, tmp_path)
    expect(again.locator(".photo[data-stored]")).to_have_count(9 - len(left(again)))
    again.get_by_role("button", name="Go on and train").click()
    job = started(again, service)
    assert (job["name"], job["options"]["time_budget"]) == ("twice", 7.0)
    assert 1 <= len(sent) <= 5
    assert files_of(service, job["capture"]) == {
        f"images/{path.name}": digest(path) for path in sorted(tmp_path.iterdir())
    }
    opened(again)
    expect(again.locator("#go-on")).to_have_count(0)

    # A page that was closed when all had arrived: nothing was interrupted, whether its job began or not.
    other = service.http.post("/v1/captures", json={"name": "whole"}).json()["id"]
    service.http.put(f"/v1/captures/{other}/images/0.jpg", content=(tmp_path / "0.jpg").read_bytes())
    remember = """(capture) => localStorage.setItem("splatmill.upload", JSON.stringify({
      key: "k", capture, name: "whole", options: { time_budget: "8s" }, files: [["images", "0.jpg", 60000]],
      at: new Date().toISOString(),
    }))"""
    for capture, words, budget in ((other, "whole: 1 file", "8s"), (job["capture"], "", "")):
        again.evaluate(remember, capture)
        opened(again)
        expect(again.locator("#place")).to_contain_text(words) if words else expect(
            again.locator("#place")
        ).to_be_empty()
        expect(again.locator("#option-time_budget")).to_have_value(budget)


def left(page: Page) -> list[str]:
    """The names of the photos that the server does not hold."""
    return page.locator(".photo:not([data-stored]) .name").all_inner_texts()


def slow(visit: Visit, page: Page, rate: int) -> None:
    """Let the page send `rate` bytes a second; 0 is as fast as it can."""
    session = visit.context.new_cdp_session(page)
    session.send("Network.enable")
    limits = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": rate or -1}
    session.send("Network.emulateNetworkConditions", limits)


def test_a_large_file_goes_on_where_it_broke_off(
    visit: Visit, service: Up, photos: Path, tmp_path: Path, jobs: None
) -> None:
    archive = tmp_path / "walk.zip"
    with zipfile.ZipFile(archive, "w") as zipped:
        for path in sorted(photos.iterdir()):
            zipped.write(path, f"walk/images/{path.name}")
        zipped.writestr("walk/notes.bin", random.Random(2).randbytes(20_000_000))
    visit.watched.allow("Failed to load resource")
    page = opened(visit.page)
    give(page, archive)
    expect(page.locator("#others")).to_contain_text("walk.zip (zip archive")
    expect(page.locator("#others")).to_contain_text("15 files inside")
    slow(visit, page, 6_000_000)
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#sent-text")).to_contain_text(re.compile(r"(9|1\d)\.\d MB of 20"), timeout=CHECKED)
    page.get_by_role("button", name="Pause").click()
    expect(page.get_by_role("button", name="Go on")).to_be_enabled()
    expect(page.locator("#doing")).to_have_text("Paused")
    expect(page.locator("#sent-text")).not_to_contain_text("/s")
    offsets: list[int] = []

    def note(request: Request) -> None:
        if request.method == "PATCH":
            offsets.append(int(request.headers["upload-offset"]))

    page.on("request", note)
    slow(visit, page, 0)
    page.get_by_role("button", name="Go on").click()
    job = started(page, service)
    assert offsets
    assert min(offsets) >= 8 << 20
    assert files_of(service, job["capture"]) == {"images/walk.zip": digest(archive)}


def test_a_lost_connection_is_waited_for(visit: Visit, service: Up, photos: Path, jobs: None) -> None:
    visit.watched.allow("Failed to load resource|ERR_INTERNET_DISCONNECTED")
    page = opened(visit.page)
    give(page, photos)
    lost: list[str] = []

    def lose(route: Any) -> None:
        if len(lost) < 3:
            lost.append(route.request.url)
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/v1/captures/*/images/*", lose)
    page.get_by_role("button", name="Upload and train").click()
    job = started(page, service)
    assert len(lost) == 3
    assert len(files_of(service, job["capture"])) == 14


def test_one_job_is_made_of_two_clicks_and_of_a_lost_answer(
    visit: Visit, service: Up, photos: Path, jobs: None
) -> None:
    visit.watched.allow("Failed to load resource")
    page = opened(visit.page)
    give(page, *sorted(photos.iterdir())[:3])
    keys: list[str] = []

    def lose_first(route: Any) -> None:
        keys.append(route.request.headers["idempotency-key"])
        if len(keys) == 1:
            assert route.fetch().status == 202
            route.abort("connectionreset")
        else:
            route.continue_()

    page.route("**/v1/jobs", lose_first)
    expect(page.locator("#estimate p")).not_to_have_count(0, timeout=CHECKED)
    page.evaluate("document.getElementById('estimate').replaceChildren()")
    page.get_by_role("button", name="Upload and train").dblclick()
    # The next estimate, which is asked for as soon as the button has failed, leaves the reason where it is.
    expect(page.locator("#estimate p")).not_to_have_count(0, timeout=CHECKED)
    expect(page.get_by_text("The server did not answer.")).to_be_visible(timeout=CHECKED)
    page.get_by_role("button", name="Train", exact=True).click()
    job = started(page, service)
    assert len(keys) == 2
    assert len(set(keys)) == 1
    of_capture = service.http.get("/v1/jobs", params={"capture": job["capture"]}).json()["jobs"]
    assert [each["id"] for each in of_capture] == [job["id"]]


def test_settings_have_the_help_of_the_command_line_and_errors_beside_them(
    visit: Visit, photos: Path
) -> None:
    visit.watched.allow("status of 422")
    page = opened(visit.page)
    give(page, *sorted(photos.iterdir())[:3])
    for option in describe_options():
        help_text = page.locator(f"#option-{option.name}-help")
        expect(help_text).to_contain_text(option.help.replace("image_size", '"Image size"'))
        shown = option.name in ("preset", "within", "time_budget", "image_size")
        assert help_text.is_visible() == shown, option.name
    size = page.locator("#option-image_size")
    size.fill("5")
    expect(page.locator("#option-image_size-error")).to_have_text("It must be at least 16.")
    expect(size).to_have_attribute("aria-invalid", "true")
    size.fill("160")
    expect(page.locator("#option-image_size-error")).to_be_empty()
    expect(size).not_to_have_attribute("aria-invalid", "true")
    page.get_by_text("All settings").click()
    # What the two times are for is seen where they are typed, and in what is expected of them.
    for name, words in (
        ("within", "About 2 min for everything"),
        ("time_budget", "About 2 min for the training alone"),
    ):
        field = page.locator(f"#option-{name}")
        field.fill("2m")
        expect(page.locator("#estimate")).to_contain_text(words)
        field.fill("")
    page.get_by_label("Time for training alone").fill("soon")
    expect(page.locator("#option-time_budget-error")).to_contain_text("'soon' is not a duration")
    # Nothing is sent with settings that are not valid: the reason stands beside the button, which leads to the field.
    page.locator("#settings-all summary").click()
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#problem")).to_contain_text("Time for training alone: 'soon' is not a duration")
    expect(page.get_by_label("Time for training alone")).to_be_focused()
    expect(page.get_by_label("Time for training alone")).to_be_in_viewport()
    expect(page.get_by_role("button", name="Upload and train")).to_be_enabled()


def test_too_few_photos_are_refused_before_the_upload(page: Page, photos: Path) -> None:
    opened(page)
    for number, path in enumerate(sorted(photos.iterdir())[: MIN_PHOTOS - 1]):
        give(page, path)
        expect(page.locator(".verdict")).to_have_text(["More photos are needed."] * (number + 1))
        few = "One photo is too few" if number == 0 else f"{number + 1} photos are too few"
        expect(page.locator("#estimate")).to_contain_text(
            f"{few}. A scene needs at least {MIN_PHOTOS} that show the same things"
        )
        expect(page.locator("#estimate")).not_to_contain_text("About")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#problem")).to_contain_text("photos are too few")
    assert asked == []
    give(page, *sorted(photos.iterdir())[:MIN_PHOTOS])
    expect(page.locator('.photo[data-verdict="good"]')).to_have_count(MIN_PHOTOS)
    expect(page.locator("#problem")).to_be_empty()


def test_a_further_job_on_stored_photos_with_an_estimate(
    page: Page, service: Up, model: SmallModel, jobs: None
) -> None:
    opened(page)
    # Other tests have photos of the same name.
    link = page.get_by_role("link", name=re.compile("still life"))
    link.and_(page.locator(f"a[href$='capture={model.capture}']")).first.click()
    page.locator("html[data-ready]").wait_for()
    assert page.url.endswith(f"/?capture={model.capture}")
    expect(page.locator("#place")).to_contain_text("still life: 15 files")
    expect(page.locator("#estimate")).to_contain_text(re.compile("About .+ for everything, with 14 photos"))
    page.get_by_text("How this was derived").click()
    expect(page.locator("#estimate")).to_contain_text("per step")
    ranges = """async (given) => (await import("/page/any/new/estimate.js")).range(given).join("")"""
    for seconds, lowest, highest, words in (
        (22, 20, 41, "20 s to 40 s"),
        (31, 20, 41, "30 s (20 s to 40 s)"),
        (20, 20, 20, "20 s"),
    ):
        assert page.evaluate(ranges, {"seconds": seconds, "lowest": lowest, "highest": highest}) == words
    page.locator("#settings").get_by_text("draft", exact=True).click()
    page.get_by_role("button", name="Train", exact=True).click()
    job = started(page, service)
    assert job["capture"] == model.capture
    assert job["options"]["preset"] == "draft"


def test_a_refused_file_is_named_and_the_others_can_be_trained(
    visit: Visit, service: Up, photos: Path, jobs: None
) -> None:
    visit.watched.allow("status of 409")
    paths = sorted(photos.iterdir())[:3]
    capture = service.http.post("/v1/captures", json={"name": "taken"}).json()["id"]
    other = paths[2].read_bytes() + b"\0"
    service.http.put(f"/v1/captures/{capture}/images/{paths[0].name}", content=other)
    page = opened(visit.page, f"/?capture={capture}")
    give(page, *paths)
    page.get_by_role("button", name="Upload and train").click()
    expect(page.locator("#problem")).to_contain_text("The server refused 1 file", timeout=CHECKED)
    expect(tile(page, paths[0].name).locator(".verdict")).to_contain_text(
        "already holds images/still_00.jpg with other bytes"
    )
    page.get_by_role("button", name="Train without it").click()
    job = started(page, service)
    assert job["capture"] == capture
    names = [f"images/{path.name}" for path in paths]
    files = files_of(service, capture)
    assert files == {
        names[0]: hashlib.sha256(other).hexdigest(),
        names[1]: digest(paths[1]),
        names[2]: digest(paths[2]),
    }


def test_everything_works_by_keyboard(visit: Visit, service: Up, photos: Path, jobs: None) -> None:
    visit.page.on("filechooser", lambda _: None)  # so that dialogues are intercepted from the beginning
    page = opened(visit.page)
    tab_to(page, "#choose")
    with page.expect_file_chooser() as chooser:
        page.keyboard.press("Enter")
    chooser.value.set_files(sorted(photos.iterdir())[:4])
    expect(page.locator('.photo[data-verdict="good"]')).to_have_count(4, timeout=CHECKED)
    tab_to(page, '[name="preset"]')
    page.keyboard.press("ArrowLeft")
    expect(page.locator('[name="preset"]:checked')).to_have_value("draft")
    tab_to(page, '[aria-label="Leave out still_02.jpg"]')
    page.keyboard.press("Enter")
    expect(page.locator('[aria-label="Use still_02.jpg"]')).to_be_focused()
    tab_to(page, "#start")
    page.keyboard.press("Enter")
    job = started(page, service)
    assert job["options"]["preset"] == "draft"
    assert len(files_of(service, job["capture"])) == 3


def tab_to(page: Page, selector: str) -> None:
    for _ in range(60):
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"the tabulator does not reach {selector}")


def test_digests_are_right_without_the_browsers_own(page: Page) -> None:
    opened(page)
    script = """async (size) => {
      const { sha256, sha256InPieces } = await import("/page/any/new/looking/digest.js");
      const file = new Blob([new Uint8Array(size).map((_, index) => index % 251)]);
      const library = import.meta?.resolve?.("@noble/hashes/sha2.js") ?? "@noble/hashes/sha2.js";
      return [await sha256(file, library), await sha256InPieces(file, library)];
    }""".replace('import.meta?.resolve?.("@noble/hashes/sha2.js") ?? ', "")
    size = (4 << 20) + 17
    expected = hashlib.sha256(bytes(index % 251 for index in range(size))).hexdigest()
    assert page.evaluate(script, size) == [expected, expected]


def test_a_scene_is_called_as_its_folder_or_its_day_until_somebody_names_it(
    page: Page, photos: Path, tmp_path: Path
) -> None:
    some = sorted(photos.iterdir())[:3]
    (tmp_path / "Großer Garten").mkdir()
    for path in some:
        shutil.copy(path, tmp_path / "Großer Garten")
    opened(page)
    give(page, tmp_path / "Großer Garten")
    name = page.get_by_label("Name", exact=True)
    expect(name).to_have_value("Großer Garten")
    page.get_by_role("button", name="Remove all").click()
    give(page, *some)
    expect(name).to_have_value(re.compile(r"^[A-Z][a-z]+ \d{1,2}, \d{4}$"))
    name.fill("mine")
    give(page, tmp_path / "Großer Garten")
    expect(name).to_have_value("mine")


def test_empty_lists_leave_no_gap_above_the_photos(page: Page, photos: Path) -> None:
    give(opened(page), *sorted(photos.iterdir()))
    page.evaluate("document.getElementById('remarks').replaceChildren()")
    tools, settings, tiles = (
        page.locator(f"#{name}").bounding_box() for name in ("tools", "settings", "photos")
    )
    assert tools is not None
    assert settings is not None
    assert tiles is not None
    for above, below in ((tools, settings), (settings, tiles)):
        assert 0 < below["y"] - above["y"] - above["height"] < 24, "one distance of the stack, and not three"


def test_axe_finds_nothing_serious(service: Up, open_window: Open, photos: Path) -> None:
    axe = npm_package("axe-core") / "axe.min.js"
    visit = open_window(service)
    visit.context.add_init_script(path=axe)
    page = opened(visit.page)
    give(page, *sorted(photos.iterdir())[:3])
    page.get_by_text("All settings").click()
    expect(page.locator("#estimate")).not_to_be_empty()
    for theme, rules in (("light", "axe.run()"), ("dark", "axe.run({ runOnly: ['color-contrast'] })")):
        page.get_by_label("Theme").select_option(theme)
        problems = page.evaluate(rules)["violations"]
        serious = [one for one in problems if one["impact"] in ("serious", "critical")]
        assert not serious, json.dumps(serious, indent=1)[:3000]
