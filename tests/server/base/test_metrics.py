"""The metrics of the service: each fact is counted once, whichever process sees it, and is the same from all of them.

Redis is real, the jobs end as workers and the reaper end them, and the text is parsed by Prometheus' own library. Not
proved here: that a Prometheus server reads it, and what is asked of it (tests/server/test_monitoring.py).
"""

import re
from datetime import UTC, datetime, timedelta
from typing import Any, cast

import pytest
import redis
from prometheus_client.parser import text_string_to_metric_families

from splatmill.backplane import keys, totals
from splatmill.backplane.jobs.events import StoredEvent
from splatmill.backplane.jobs.row import JobRow, Verdict
from splatmill.backplane.queue import leases, lines, queue, workers
from splatmill.schema import JobState, Problem, StateEvent, TrainOptions
from splatmill_server.base.metrics import OF_PROCESS, SAME, SMALLEST, Metrics
from splatmill_server.base.scrape import families, of_disk, of_renderer
from splatmill_server.jobs import outcome
from tests.support.served_app import Serve, ServedApp
from tests.support.servers.queue_entries import take

Samples = dict[tuple[str, tuple[str, ...]], float]


def scraped(app: ServedApp) -> Samples:
    """The values at a scrape, by name and label values in the order of the labels' names."""
    return {
        (sample.name, tuple(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(app.http.get("/metrics").text)
        for sample in family.samples
    }


def fail(app: ServedApp, job_id: str, code: str = "diverged") -> None:
    app.begin(job_id)
    app.say(job_id, StateEvent(state=JobState.failed, problem=Problem.of(code, "It went wrong.")))


def test_ends_are_counted_once_by_whichever_process_sees_them_first(serve: Serve) -> None:
    first, second = serve(), serve()
    failed, done, withdrawn = first.job(), first.job(), first.job()
    fail(first, failed)
    first.begin(done)
    first.finish(done)
    first.http.post(f"/v1/jobs/{withdrawn}/cancel")
    for _ in range(2):
        for app in (first, second):
            app.service.reaper.tick()
    for app in (first, second):
        samples = scraped(app)
        counts = {
            name[1]: value
            for name, value in samples.items()
            if name[0] == "splatmill_jobs_ended_total" and value
        }
        assert counts == {("diverged", "failed"): 1, ("", "succeeded"): 1, ("", "cancelled"): 1}
        assert samples["splatmill_job_seconds_count", ("succeeded",)] == 1
        assert samples["splatmill_jobs_unfinished", ()] == 0
        assert samples["splatmill_records", ("jobs",)] == 3


def test_an_end_that_no_reaper_has_seen_is_counted_by_what_comes_next(app: ServedApp) -> None:
    restarted, deleted = app.job(), app.job()
    fail(app, restarted)
    fail(app, deleted)
    app.http.post(f"/v1/jobs/{restarted}/restart").raise_for_status()
    assert app.http.delete(f"/v1/jobs/{deleted}").status_code == 204
    app.service.reaper.tick()
    assert scraped(app)["splatmill_jobs_ended_total", ("diverged", "failed")] == 2
    assert scraped(app)["splatmill_jobs_unfinished", ()] == 1


def test_a_redis_that_comes_back_empty_counts_on_from_zero_and_nothing_twice(app: ServedApp) -> None:
    counted, later = app.job(), app.job()
    fail(app, counted)
    app.service.reaper.tick()
    app.redis.flushall()
    app.service.reaper.tick()
    samples = scraped(app)
    assert not any(value for (name, _), value in samples.items() if name == "splatmill_jobs_ended_total")
    assert samples["splatmill_records", ("jobs",)] == 2
    fail(app, later)
    app.service.reaper.tick()
    assert scraped(app)["splatmill_jobs_ended_total", ("diverged", "failed")] == 1


def test_a_wait_is_counted_when_it_ends_and_the_longest_one_is_shown(app: ServedApp) -> None:
    app.job(), app.job()
    for entry in cast(list[bytes], app.redis.zrange(keys.ARRIVED, 0, -1)):
        app.redis.zincrby(keys.ARRIVED, -90, entry)
    samples = scraped(app)
    assert 90 <= samples["splatmill_queue_oldest_seconds", ()] < 120
    assert ("splatmill_queue_wait_seconds_count", ("any",)) not in samples
    lease = take(app.redis)
    take(app.redis)
    samples = scraped(app)
    assert samples["splatmill_queue_oldest_seconds", ()] == 0
    waits = {
        labels[0]: value
        for (name, labels), value in samples.items()
        if name == "splatmill_queue_wait_seconds_bucket"
    }
    assert [waits[bound] for bound in ("60.0", "120.0", "+Inf")] == [0, 2, 2]
    assert 180 <= samples["splatmill_queue_wait_seconds_sum", ("any",)] < 240
    assert lines.hand_back(app.redis, lease)
    take(app.redis)
    again = scraped(app)
    assert again["splatmill_queue_wait_seconds_count", ("any",)] == 3
    assert again["splatmill_queue_wait_seconds_sum", ("any",)] < 240, "it begins anew when it is handed back"


def test_what_is_withdrawn_waits_no_longer(connection: redis.Redis) -> None:
    for job_id in ("a" * 16, "b" * 16):
        connection.hset(keys.job(job_id), "owner", "somebody")
        queue.enqueue(connection, job_id, 1)
    assert connection.zcard(keys.ARRIVED) == 2
    queue.withdraw(connection, "a" * 16, 1)
    assert connection.zrange(keys.ARRIVED, 0, -1) == [b"b" * 16 + b"-1"]


def test_a_lost_worker_is_counted_with_its_entry(app: ServedApp) -> None:
    app.job()
    for _ in range(leases.MAX_LOST):
        assert leases.requeue(app.redis, take(app.redis), if_expired=False) != "kept"
    samples = scraped(app)
    assert samples["splatmill_workers_lost_total", ("waiting",)] == leases.MAX_LOST - 1
    assert samples["splatmill_workers_lost_total", ("failed",)] == 1


def test_the_workers_are_told_in_sum_and_not_one_by_one(app: ServedApp) -> None:
    now = datetime.fromtimestamp(app.redis.time()[0], UTC)
    for name, state, silent, spare in (("a", "busy", 3, 700), ("b", "busy", 40, -5), ("c", "idle", 1, 900)):
        app.redis.sadd("rq:workers", f"rq:worker:{name}")
        beat = (now - timedelta(seconds=silent)).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        record: Any = (
            {"state": state, "last_heartbeat": beat} | workers.served(("any",)) | workers.spare(spare)
        )
        app.redis.hset(f"rq:worker:{name}", mapping=record)
    samples = scraped(app)
    assert [samples["splatmill_workers", (state,)] for state in ("idle", "busy", "suspended")] == [1, 2, 0]
    assert 39 <= samples["splatmill_worker_heartbeat_age_seconds", ()] < 60
    assert samples["splatmill_worker_disk_spare_bytes", ()] == -5
    assert samples["splatmill_queue_workers", ("any",)] == 3


def test_a_scrape_costs_no_more_with_more_records(app: ServedApp) -> None:
    def commands() -> int:
        """Commands of one scrape: those of two scrapes without those of one."""

        def processed() -> int:
            return int(app.redis.info("stats")["total_commands_processed"])

        counts = []
        for scrapes in (1, 3):
            before = processed()
            for _ in range(scrapes):
                scraped(app)
            counts.append(processed() - before)
        return (counts[1] - counts[0]) // 2

    capture = app.capture()
    app.job(capture)
    few = commands()
    for _ in range(20):
        app.job(capture)
    assert commands() == few


def test_without_redis_there_is_no_value_rather_than_an_old_one() -> None:
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in families(None)
        for sample in family.samples
    }
    assert samples == {("splatmill_redis_up",): 0}


def test_uploads_and_storage_are_counted_with_their_errors(
    app: ServedApp, monkeypatch: pytest.MonkeyPatch
) -> None:
    app.capture("a.jpg", "b.jpg", "c.jpg")
    samples = scraped(app)
    assert samples["splatmill_uploaded_files_total", ()] == 3
    assert samples["splatmill_uploaded_bytes_total", ()] == 3 * len(b"\xff\xd8\xff photo 0")
    writes = samples["splatmill_storage_operations_total", ("write", "ok")]
    assert writes > 3
    assert samples["splatmill_storage_seconds_count", ("write",)] == writes
    assert samples["splatmill_storage_spare_bytes", ()] > 0
    root = app.service.storage.root
    assert root is not None
    (root / "captures" / ("f" * 16)).write_text("a file where a folder would have to be")
    with pytest.raises(Exception, match="could not write"):
        app.service.storage.put(f"captures/{'f' * 16}/capture.json", b"{}")
    assert scraped(app)["splatmill_storage_operations_total", ("write", "failed")] == 1


def test_the_end_of_an_attempt_is_where_its_stage_ends() -> None:
    """States of two attempts: the first was lost while it trained, so its training has no known end."""
    began = datetime(2026, 1, 1, tzinfo=UTC)

    def said(seconds: float, attempt: int, state: JobState) -> StoredEvent:
        moment = int((began + timedelta(seconds=seconds)).timestamp() * 1000)
        return StoredEvent(f"{moment}-0", 1, attempt, StateEvent(state=state))

    states = [
        said(10, 1, JobState.preparing),
        said(12, 1, JobState.sfm),
        said(42, 1, JobState.training),
        said(500, 2, JobState.preparing),
        said(501, 2, JobState.sfm),
        said(502, 2, JobState.training),
        said(602, 2, JobState.exporting),
    ]
    job_row = JobRow(
        id="a" * 16, capture="b" * 16, options=TrainOptions(), created_at=began, queued_at=began, generation=1
    )
    assert outcome.increments(job_row, states) == {}, "it has not ended"
    cancelled = job_row.model_copy(
        update={"verdict": Verdict(state="cancelled", at=began + timedelta(seconds=605), after=states[-1].id)}
    )
    spent = outcome.stage_seconds(cancelled, states)
    assert spent == pytest.approx({"preparing": 3, "sfm": 31, "training": 100, "exporting": 3})
    counted = outcome.increments(cancelled, states)
    assert counted["splatmill_jobs_ended|cancelled|"] == 1
    assert counted["splatmill_job_seconds|cancelled|sum"] == pytest.approx(605)


def test_every_metric_says_how_processes_are_put_together() -> None:
    all_families = [*Metrics().registry.collect(), *families(None), *of_disk(1), *of_renderer(None)]
    assert len({family.name for family in all_families}) == len(all_families) > 30
    for family in all_families:
        assert family.documentation.endswith((OF_PROCESS, SAME, SMALLEST)), family.name
        assert family.name.startswith("splatmill_")


def test_a_hash_of_another_version_is_read_as_far_as_it_is_known() -> None:
    stored = {
        b"splatmill_jobs_ended|failed|diverged": b"2",
        b"splatmill_jobs_ended|failed": b"9",
        b"splatmill_of_tomorrow|x": b"1",
        b"splatmill_stage_seconds|sfm|99": b"1",
        b"splatmill_stage_seconds|sfm|3": b"4",
        b"splatmill_stage_seconds|sfm|sum": b"31.5",
    }
    metrics = totals.read(stored)
    assert metrics["splatmill_jobs_ended"].values == {("failed", "diverged"): 2}
    distribution = metrics["splatmill_stage_seconds"].distributions["sfm",]
    assert (distribution.counts[3], sum(distribution.counts), distribution.sum) == (4, 4, 31.5)


def test_the_labels_of_requests_come_from_closed_sets(app: ServedApp) -> None:
    before = len(app.http.get("/metrics").content)
    for number in range(300):
        app.http.request(f"{'HACK' * 500}{number}", f"/made-up/{number}")
        app.http.request(f"GET{number}", "/v1/jobs")
    text = app.http.get("/metrics").text
    assert len(text) - before < 10_000
    assert "HACK" not in text
    assert "made-up" not in text
    assert 'splatmill_http_requests_total{method="other",route="other",status="404"} 300.0' in text


def test_a_code_and_a_state_that_nobody_knows_count_as_other(app: ServedApp) -> None:
    job_id = app.job()
    app.begin(job_id)
    made_up = Problem.of("diverged", "It went wrong.").model_copy(update={"code": "made_up" * 20})
    app.say(job_id, StateEvent(state=JobState.failed, problem=made_up))
    app.service.reaper.tick()
    app.redis.sadd("rq:workers", "rq:worker:a")
    app.redis.hset("rq:worker:a", mapping={"state": "made up", "last_heartbeat": "x"})
    samples = scraped(app)
    assert samples["splatmill_jobs_ended_total", ("other", "failed")] == 1
    assert samples["splatmill_workers", ("other",)] == 1
    assert not re.search("made[ _]up", app.http.get("/metrics").text)
