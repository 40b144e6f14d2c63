"""Pages of lists cost the same however many records there are: counted operations, and what is on the pages.

Not proved here: seconds. `splatmill bench capacity` measures them, with a hundred thousand records.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import redis
from _capacity.operations import counted
from _capacity.seed import OWNERS, Seeded, seed

from splatmill.backplane import keys, lists
from splatmill.backplane.storage.storage import StorageError, StorageFullError
from splatmill.schema import JobState
from splatmill_server.base.filters import Filter, JobFilter
from splatmill_server.base.settings import Settings
from splatmill_server.service import Service

COUNT = 120
"""Records of each kind; a page has at most PAGE."""

PAGE = 10


@pytest.fixture(scope="module")
def storage_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Seeded]:
    """Storage with COUNT captures, jobs and models."""
    from splatmill.backplane.storage.storage import Storage

    folder = tmp_path_factory.mktemp("seeded")
    return folder, seed(Storage((folder / "storage").as_uri()), COUNT)


@pytest.fixture
def seeded(
    storage_folder: tuple[Path, Seeded], redis_url: str, connection: redis.Redis
) -> Iterator[tuple[Service, Seeded]]:
    """A service over the seeded storage, and a Redis that has come back empty."""
    folder, records = storage_folder
    service = Service.of(Settings(redis_url=redis_url, data=folder))
    with contextlib.closing(service.redis):
        yield service, records


Page = Callable[[str | None], tuple[list[str], str | None]]


def all_pages(page: Page) -> tuple[list[str], int]:
    """The ids on all pages, in order, and the number of pages."""
    all_ids, cursor, count = [], None, 0
    while True:
        ids, cursor = page(cursor)
        all_ids += ids
        count += 1
        if cursor is None:
            return all_ids, count


def jobs(service: Service, only: JobFilter | None = None) -> Page:
    def page(cursor: str | None) -> tuple[list[str], str | None]:
        listing = service.jobs.list(cursor, PAGE, only)
        return [job.id for job in listing.jobs], listing.cursor

    return page


def captures(service: Service, only: Filter | None = None) -> Page:
    def page(cursor: str | None) -> tuple[list[str], str | None]:
        listing = service.captures.list(cursor, PAGE, only)
        return [capture.id for capture in listing.captures], listing.cursor

    return page


def models(service: Service, only: Filter | None = None) -> Page:
    def page(cursor: str | None) -> tuple[list[str], str | None]:
        listing = service.models.list(cursor, PAGE, only)
        return [model.id for model in listing.models], listing.cursor

    return page


def test_the_pages_hold_every_record_once_newest_first(seeded: tuple[Service, Seeded]) -> None:
    service, records = seeded
    newest = sorted(records.captures, reverse=True)
    assert all_pages(jobs(service)) == (newest, COUNT // PAGE)
    assert all_pages(captures(service)) == (newest, COUNT // PAGE)
    assert all_pages(models(service))[0] == sorted(records.succeeded, reverse=True)
    mine = [name for name in newest if int(name, 16) % OWNERS == 3]
    assert all_pages(jobs(service, JobFilter(owner="owner3")))[0] == mine
    assert all_pages(captures(service, Filter(owner="owner3")))[0] == mine
    assert all_pages(models(service, Filter(owner="owner3")))[0] == [
        name for name in mine if name in records.succeeded
    ]
    for state, ids in (("queued", records.queued), ("failed", records.failed)):
        only = JobFilter(states=frozenset({JobState(state)}))
        assert all_pages(jobs(service, only))[0] == sorted(ids, reverse=True)
    assert all_pages(jobs(service, JobFilter(capture=newest[7])))[0] == [newest[7]]
    assert all_pages(captures(service, Filter(name="scene 11")))[0] == [
        f"{number:016x}" for number in (119, 118, 117, 116, 115, 114, 113, 112, 111, 110, 11)
    ]


def test_a_page_takes_a_few_round_trips_and_nothing_of_storage(seeded: tuple[Service, Seeded]) -> None:
    service, records = seeded
    service.lists.ensure(0.0)
    failed = JobFilter(states=frozenset({JobState.failed}))
    pages: dict[str, tuple[Page, int]] = {
        "jobs": (jobs(service), 2),
        "jobs of an owner": (jobs(service, JobFilter(owner="owner3")), 2),
        # One more for a glance at those that have not ended.
        "jobs in a state": (jobs(service, failed), 3),
        "jobs of a name": (jobs(service, JobFilter(name="job 11")), 3),
        "jobs on a capture": (jobs(service, JobFilter(capture=records.captures[7])), 2),
        "captures": (captures(service), 2),
        "captures of an owner": (captures(service, Filter(owner="owner3")), 2),
        "models": (models(service), 2),
        "models of an owner": (models(service, Filter(owner="owner3")), 2),
    }
    waiting = 6  # a page with jobs that wait also asks for their places in the queue
    for name, (page, most) in pages.items():
        page(None)  # what lists show of captures and models is read from storage once
        with counted() as operations:
            ids, _ = page(None)
        assert ids, name
        extra = waiting if set(ids) & set(records.queued) else 0
        assert operations.round_trips <= most + extra, name
        assert not operations.storage, name


def test_a_page_of_models_reads_each_model_once(seeded: tuple[Service, Seeded]) -> None:
    service, records = seeded
    service.lists.ensure(0.0)
    with counted() as operations:
        models(service)(None)
    assert sum(operations.storage.values()) <= 6 * (PAGE + 1)
    kept = service.redis.hlen(keys.records("models"))
    assert kept == len(records.succeeded)


def test_lists_are_made_from_storage_in_one_reading_of_each_record(seeded: tuple[Service, Seeded]) -> None:
    service, records = seeded
    with counted() as operations:
        service.lists.ensure(0.0)
    ended = len(records.failed) + len(records.succeeded)
    # capture.json of each; the log of each ended job, which has its model too; request and log of each queued one.
    assert operations.storage["get"] == COUNT + ended + 2 * len(records.queued)
    assert operations.storage["children"] == 3
    assert operations.storage["walk"] == 1
    # What is in the bin, and which jobs were renamed: once for those that have ended, once for others.
    assert operations.storage["entries"] == 3
    assert set(operations.storage) == {"get", "children", "walk", "entries"}
    assert operations.round_trips < 60, "in batches"
    with counted() as operations:
        service.lists.ensure(0.0)
    assert (operations.round_trips, sum(operations.storage.values())) == (1, 0)


def test_the_reaper_takes_the_same_round_trips_for_many_jobs_as_for_few(
    seeded: tuple[Service, Seeded],
) -> None:
    service, records = seeded
    service.lists.ensure(0.0)
    service.redis.delete(keys.RESTORED)
    service.reaper.tick()  # puts the queued jobs into the queue, and notes the ended ones
    assert len(service.jobs.list_active()) == len(records.queued)
    with counted() as operations:
        service.reaper.tick()
    assert operations.round_trips <= 14
    assert not operations.storage


def test_a_new_record_is_on_the_first_page_at_once_and_a_deleted_one_is_not(
    seeded: tuple[Service, Seeded],
) -> None:
    service, _ = seeded
    service.lists.ensure(0.0)
    made, _ = service.captures.create("new", owner="owner3")
    for only in (Filter(), Filter(owner="owner3"), Filter(name="NEW")):
        assert captures(service, only)(None)[0][0] == made.id
    service.captures.delete(made.id)
    for only in (Filter(), Filter(owner="owner3")):
        assert captures(service, only)(None)[0][0] != made.id
    assert service.redis.zscore(lists.name("captures"), made.id) is None
    assert not service.redis.hexists(keys.records("captures"), made.id)


def test_what_was_stored_while_redis_was_away_is_listed_by_the_next_sweep(
    seeded: tuple[Service, Seeded],
) -> None:
    service, records = seeded
    service.lists.ensure(0.0)
    newest, model = records.captures[-1], records.succeeded[-1]
    for kind, name in (("captures", newest), ("models", model)):
        owner = f"owner{int(name, 16) % OWNERS}"
        lists.remove(service.redis, kind, name, owner)  # type: ignore[arg-type]  # one of two kinds
    assert captures(service)(None)[0][0] != newest
    service.sweeper.sweep()
    assert all_pages(captures(service))[0] == sorted(records.captures, reverse=True)
    assert all_pages(models(service, Filter(owner=f"owner{int(model, 16) % OWNERS}")))[0][0] == model


def test_a_capture_that_is_stored_while_the_lists_are_made_is_listed(
    seeded: tuple[Service, Seeded], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, _ = seeded
    storage = service.captures.storage
    put_new = storage.put_new

    def late(path: str, data: bytes) -> bool:
        service.lists.ensure(0.0)
        return put_new(path, data)

    monkeypatch.setattr(storage, "put_new", late)
    made, _ = service.captures.create("late", owner="owner3")
    assert captures(service, Filter(owner="owner3"))(None)[0][0] == made.id
    service.captures.delete(made.id)


def test_a_capture_that_storage_refuses_is_in_no_list(
    seeded: tuple[Service, Seeded], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, records = seeded
    service.lists.ensure(0.0)

    def full(path: str, data: bytes) -> bool:
        raise StorageFullError("no space left")

    with monkeypatch.context() as broken:
        broken.setattr(service.captures.storage, "put_new", full)
        with pytest.raises(StorageFullError):
            service.captures.create(owner="owner3")
    assert not service.captures.unlisted, "nothing was stored, so that storage need not be looked through"
    assert service.redis.zcard(lists.name("captures")) == len(records.captures)
    mine = [name for name in records.captures if int(name, 16) % OWNERS == 3]
    assert service.redis.zcard(lists.name("captures", owner="owner3")) == len(mine)


def test_a_capture_of_which_storage_did_not_tell_that_it_was_stored_is_listed(
    seeded: tuple[Service, Seeded], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, records = seeded
    service.lists.ensure(0.0)
    service.relisting.look()
    put_new = service.captures.storage.put_new

    def cut(path: str, data: bytes) -> bool:
        put_new(path, data)
        raise StorageError("the connection broke before the answer")

    with monkeypatch.context() as broken:
        broken.setattr(service.captures.storage, "put_new", cut)
        with pytest.raises(StorageError):
            service.captures.create(owner="owner3")
    assert service.relisting.look() == 1
    (made,) = set(all_pages(captures(service))[0]) - set(records.captures)
    service.captures.delete(made)


def test_a_capture_that_was_stored_and_not_listed_is_listed_when_its_key_is_repeated(
    seeded: tuple[Service, Seeded], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is killed between the two leaves such a capture."""
    service, _ = seeded
    service.lists.ensure(0.0)
    with monkeypatch.context() as killed:
        killed.setattr(service.captures, "_list", lambda made: None)
        made, _ = service.captures.create(owner="owner3", key="digest of the photos")
    assert captures(service)(None)[0][0] != made.id
    assert service.captures.create(owner="owner3", key="digest of the photos") == (made, False)
    assert captures(service)(None)[0][0] == made.id
    service.captures.delete(made.id)


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ("anna's kit", "Anna\u2019s Kitchen"),
        ("anna\u2019s", "ANNA'S kitchen"),
        ("rock 'n'", "Rock \u2018n\u2019 roll"),
        ("anna\u00b4s", "Anna\u2019s"),
        ('"big"', "The \u201cBig\u201d one"),
        ("2024-25", "Winter 2024\u201325"),
        ("cafe", "Caf\u00e9 Muller"),
        ("muller", "M\u00fcller"),
        ("m\u00fcller", "Mu\u0308ller"),
        ("strasse", "Hauptstra\u00dfe"),
    ],
)
def test_a_name_is_found_as_people_type_it(asked: str, named: str) -> None:
    assert Filter(name=asked).admits("me", named)
    assert Filter(tag=named).admits("me", None, [named.upper()])
    assert not Filter(name=asked).admits("me", named[1:3])
