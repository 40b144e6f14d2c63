"""Quotas: what fits is stored, what does not is refused with the figures, before and while it arrives.

Not proved here: how the limits get into a key (tests/server/test_keys), and two API processes under load.
"""

import asyncio
import json
import threading
from collections.abc import Iterator

import httpx
import pytest

from splatmill.backplane import keys
from splatmill.backplane.storage import layout
from splatmill.schema import KeyLimits, Scope
from splatmill_server.access.caller import Caller
from splatmill_server.base.problems import ProblemError
from splatmill_server.space import quota as quota_module
from splatmill_server.space import usage as usage_module
from tests.server.space.conftest import Person, ServePeople
from tests.support.served_app import ServedApp, problem, stored
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow  # a server for each case

OVERHEAD = 1200
"""Bytes that records and digests of a small capture take at most."""


@pytest.fixture
def ann(people: ServedApp) -> Person:
    return Person(people.http, "ann", limit=10_000)


def bytes_of(app: ServedApp, owner: str = "ann") -> int:
    return app.service.usage.ledger.bytes_of(owner)


def test_a_key_that_only_reads_does_not_lift_the_limit_of_its_owner(people: ServedApp) -> None:
    writer = Caller("ann", scopes=frozenset({Scope.train}), limits=KeyLimits(bytes_stored=1000))
    reader = Caller("ann", scopes=frozenset({Scope.read}))
    for caller in (writer, reader):
        people.service.quota.note(caller)  # as a download does in a format that is not stored yet
    assert people.service.quota.known_limit("ann") == 1000


@pytest.mark.parametrize("name", ["a.jpg", "\u65e5\u672c.jpg", "\U0001f34e" * 60 + ".jpg"])
def test_what_lies_beside_a_file_is_counted_for_any_name(name: str) -> None:
    digest = "f" * 64
    row = json.dumps({f"images/{name}": [digest, 1 << 40]}, separators=(",", ":"))
    assert len(digest) + len(row) <= quota_module.bytes_beside(name)


def test_a_file_that_does_not_fit_is_refused_before_its_body_is_sent(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(6000)
    refused = problem(ann.put(capture, "more.jpg", b"x" * 5000), 507, "quota_exceeded")
    assert refused["facts"]["limit"] == 10_000
    assert refused["facts"]["size"] == 5000
    assert 6000 <= refused["facts"]["used"] < 6000 + OVERHEAD
    assert refused["facts"]["file"] == "images/more.jpg"
    assert "splatmill storage" in refused["advice"]
    assert ann.put(capture, "less.jpg", b"x" * 3000).status_code == 201
    assert len(ann("GET", f"/v1/captures/{capture}").json()["files"]) == 2
    assert Person(people.http, "bob", limit=10_000).capture(9000)
    assert Person(people.http, "ann").capture(9000)  # a key without a limit


def test_a_file_of_unknown_size_is_cut_off_where_the_quota_ends(
    people: ServedApp, ann: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quota_module, "STEP", 1024)
    capture, sent = ann.capture(100), 0

    def chunks(count: int) -> Iterator[bytes]:
        nonlocal sent
        for _ in range(count):
            sent += 500
            yield b"c" * 500

    assert ann.put(capture, "fits.jpg", chunks(17)).status_code == 201
    before = bytes_of(people)
    assert 8600 <= before < 8600 + OVERHEAD
    problem(ann.put(capture, "more.jpg", chunks(3)), 507, "quota_exceeded")
    assert bytes_of(people) == before
    files = ann("GET", f"/v1/captures/{capture}").json()["files"]
    assert [file["name"] for file in files] == ["0.jpg", "fits.jpg"]
    people.service.usage.scan()
    assert 8600 <= bytes_of(people) <= before


def test_what_is_stored_may_be_sent_again_when_the_quota_is_used_up(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(9000)
    before = bytes_of(people)
    for _ in range(3):
        assert ann.put(capture, "0.jpg", b"\0" * 9000).status_code == 200
    assert bytes_of(people) == before
    problem(ann.put(capture, "0.jpg", b"o" * 9000), 409, "name_taken")


def test_deleting_a_capture_makes_room_at_once(people: ServedApp, ann: Person) -> None:
    for _ in range(4):
        capture = ann.capture(9000)
        problem(ann.put(capture, "more.jpg", b"x" * 2000), 507, "quota_exceeded")
        assert ann("DELETE", f"/v1/captures/{capture}").status_code == 204
        assert bytes_of(people) == 0


def test_of_two_uploads_at_once_only_those_that_fit_are_taken(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(100)
    begun, go_on = threading.Event(), threading.Event()

    def slow() -> Iterator[bytes]:
        yield b"s" * 3000
        begun.set()
        assert go_on.wait(60)
        yield b"s" * 3000

    answers: list[httpx.Response] = []
    headers = {"X-Owner": "ann", "X-Limit": "10000", "Content-Length": "6000"}
    path = f"/v1/captures/{capture}/images/slow.jpg"
    first = threading.Thread(
        target=lambda: answers.append(people.http.put(path, content=slow(), headers=headers))
    )
    first.start()
    assert begun.wait(60)
    wait_for(lambda: bytes_of(people) > 6000)
    problem(ann.put(capture, "second.jpg", b"x" * 5000), 507, "quota_exceeded")
    assert ann.put(capture, "third.jpg", b"x" * 1000).status_code == 201
    go_on.set()
    first.join(60)
    assert answers[0].status_code == 201
    assert 7100 <= bytes_of(people) < 7100 + OVERHEAD


def test_a_job_is_refused_once_the_quota_is_used_up_and_a_running_one_goes_on(
    people: ServedApp, ann: Person
) -> None:
    capture = ann.capture(4000, 4000)
    job_id = ann("POST", "/v1/jobs", json={"capture": capture}).json()["id"]
    people.begin(job_id)
    people.service.storage.put(f"{layout.capture_sfm(capture)}/database.db", b"s" * 5000)
    people.service.usage.scan()
    refused = problem(ann("POST", "/v1/jobs", json={"capture": capture}), 507, "quota_exceeded")
    assert refused["facts"]["used"] > 10_000
    assert "size" not in refused["facts"]
    form = {"files": [("images", (f"{n}.jpg", b"photo %d" % n)) for n in range(2)]}
    problem(ann("POST", "/v1/jobs", **form), 507, "quota_exceeded")
    problem(ann("POST", "/v1/captures", json={}), 507, "quota_exceeded")
    people.finish(job_id)
    assert people.state(job_id) == "succeeded"


def test_a_restart_that_cannot_be_names_the_reason_and_not_the_quota(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(4000, 4000)
    job = ann("POST", "/v1/jobs", json={"capture": capture}).json()["id"]
    people.service.storage.put(f"{layout.capture_sfm(capture)}/database.db", b"s" * 5000)
    people.service.usage.scan()
    waits = ann("POST", f"/v1/jobs/{job}/restart")
    assert (waits.status_code, waits.json()["state"]) == (202, "queued")
    people.begin(job)
    problem(ann("POST", f"/v1/jobs/{job}/restart"), 409, "job_running")
    people.finish(job)
    problem(ann("POST", f"/v1/jobs/{job}/restart"), 507, "quota_exceeded")


def test_a_file_that_was_there_already_counts_once(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(100)
    path = f"/v1/captures/{capture}/images/twice.zip"
    sent, body = {"X-Owner": "ann", "X-Limit": "10000"}, b"p" * 3000
    whole = {"Content-Type": "application/partial-upload", "Upload-Complete": "?1", "Upload-Offset": "0"}
    begun = people.http.put(path, headers=sent | {"Upload-Complete": "?0", "Upload-Length": "3000"})
    assert ann.put(capture, "twice.zip", body).status_code == 201
    before = bytes_of(people)
    again = people.http.patch(begun.headers["location"], content=body, headers=sent | whole)
    assert again.status_code == 200, again.text
    assert bytes_of(people) == before


def test_a_job_that_was_created_is_answered_again_when_the_quota_is_used_up(
    people: ServedApp, ann: Person
) -> None:
    capture = ann.capture(4000, 4000)

    def create() -> httpx.Response:
        headers = {"X-Owner": "ann", "X-Limit": "10000", "Idempotency-Key": "once"}
        return people.http.post("/v1/jobs", json={"capture": capture}, headers=headers)

    made = create().json()["id"]
    people.service.storage.put(f"{layout.capture_sfm(capture)}/database.db", b"s" * 5000)
    people.service.usage.scan()
    assert create().json()["id"] == made


def test_files_of_a_form_are_counted_one_by_one(people: ServedApp, ann: Person) -> None:
    form = {"files": [("images", (f"{n}.jpg", bytes([n]) * 4000)) for n in range(3)]}
    problem(ann("POST", "/v1/jobs", **form), 507, "quota_exceeded")
    assert bytes_of(people) < OVERHEAD
    assert ann("POST", "/v1/jobs", files=form["files"][:2]).status_code == 202
    assert 8000 <= bytes_of(people) < 8000 + 2 * OVERHEAD


def test_an_upload_in_several_requests_is_checked_as_a_whole_and_counted_in_parts(
    people: ServedApp, ann: Person
) -> None:
    capture = ann.capture(100)
    path = f"/v1/captures/{capture}/images/large.zip"
    whole = {"X-Owner": "ann", "X-Limit": "10000", "Upload-Complete": "?0"}
    too_large = people.http.put(path, headers=whole | {"Upload-Length": "20000"})
    problem(too_large, 507, "quota_exceeded")
    begun = people.http.put(path, headers=whole | {"Upload-Length": "8000"})
    assert begun.status_code == 201, begun.text
    before = bytes_of(people)
    patch = {"Content-Type": "application/partial-upload", "Upload-Offset": "0"}
    sent = people.http.patch(begun.headers["location"], content=b"p" * 5000, headers=whole | patch)
    assert sent.status_code == 204, sent.text
    assert bytes_of(people) == before + 5000
    problem(ann.put(capture, "other.jpg", b"x" * 6000), 507, "quota_exceeded")
    last = whole | patch | {"Upload-Offset": "5000", "Upload-Complete": "?1"}
    assert people.http.patch(begun.headers["location"], content=b"p" * 3000, headers=last).status_code == 201
    assert before + 8000 < bytes_of(people) < before + 8000 + OVERHEAD
    people.service.usage.scan()
    assert 8100 < bytes_of(people) < before + 8000 + OVERHEAD


def test_the_setting_is_the_limit_of_every_owner_whose_key_has_none(serve_people: ServePeople) -> None:
    app = serve_people(quota="8kB")
    ann, chief = Person(app.http, "ann"), Person(app.http, "chief")
    capture = ann.capture(4000)
    problem(ann.put(capture, "more.jpg", b"x" * 5000), 507, "quota_exceeded")
    ann.limit = 20_000
    assert ann.put(capture, "more.jpg", b"x" * 5000).status_code == 201
    uses = {use["owner"]: use["limit"] for use in chief("GET", "/v1/storage").json()["owners"]}
    assert uses["ann"] == 20_000
    assert ann("GET", "/v1/storage").json()["owners"][0]["limit"] == 20_000
    # An admin who adds to somebody else's capture does so within the limit of the server.
    problem(chief.put(capture, "third.jpg", b"x" * 5000), 507, "quota_exceeded")


def test_an_import_has_the_limit_of_the_key_that_was_last_used(people: ServedApp, ann: Person) -> None:
    capture = ann.capture(9000)

    async def fetched() -> None:
        async with people.service.quota.upload(None, capture, 5000):
            raise AssertionError("it does not fit")

    with pytest.raises(ProblemError) as caught:
        asyncio.run(fetched())
    assert caught.value.problem.code == "quota_exceeded"


def test_uploads_without_a_limit_do_not_depend_on_redis_and_those_with_one_wait_for_it(
    serve_people: ServePeople,
) -> None:
    app = serve_people(redis_url="unix:///nowhere.sock")
    capture = Person(app.http, "ann").capture(100)
    assert f"captures/{capture}/files/images/0.jpg" in stored(app)
    limited = Person(app.http, "ann", limit=10_000)
    problem(limited.put(capture, "1.jpg", b"x"), 503, "queue_unavailable")
    problem(limited("POST", "/v1/captures", json={}), 503, "queue_unavailable")


def test_figures_lost_with_redis_are_scanned_before_an_upload_is_judged(
    people: ServedApp, ann: Person
) -> None:
    capture = ann.capture(9000)
    people.redis.delete(*people.redis.keys(f"{keys.PREFIX}stored*"))
    problem(ann.put(capture, "more.jpg", b"x" * 2000), 507, "quota_exceeded")


def test_nothing_is_admitted_before_it_is_known_what_is_stored(
    people: ServedApp, ann: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = Person(people.http, "ann").capture(9000)
    monkeypatch.setattr(usage_module, "_FIRST_SCAN_SECONDS", 0.1)
    people.redis.delete(*people.redis.keys(f"{keys.PREFIX}stored*"))
    people.redis.set(keys.SCAN_LOCK, "another process", ex=60)
    problem(ann.put(capture, "more.jpg", b"x" * 2000), 503, "storage_unavailable")
    problem(ann("POST", "/v1/captures", json={}), 503, "storage_unavailable")
    people.redis.delete(keys.SCAN_LOCK)
    problem(ann.put(capture, "more.jpg", b"x" * 2000), 507, "quota_exceeded")
