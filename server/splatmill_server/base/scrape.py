"""Metrics shared by all API processes, read from Redis in two round trips.

None is cached: without Redis a metric has no value, rather than an old one.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import redis
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from splatmill.backplane import keys, lists, memory, totals
from splatmill.backplane.memory import RedisMemory
from splatmill.backplane.queue import lines, rq_keys, workers
from splatmill.backplane.queue.lines import LINES, Waiting
from splatmill.backplane.queue.workers import WorkerRecord
from splatmill.backplane.rendering import RendererState
from splatmill.backplane.totals import Counted, Distribution, Total
from splatmill_server.base.metrics import SAME, SMALLEST

_STATES = ("idle", "busy", "suspended")
_KINDS: tuple[lists.Kind, ...] = ("captures", "jobs", "models")

SERVICE_FAULTS = (
    "attempts_exhausted",
    "capture_incomplete",
    "internal_error",
    "out_of_memory",
    "queue_unavailable",
    "storage_full",
    "storage_unavailable",
    "storage_unwritable",
    "worker_disk_full",
    "worker_lost",
)
"""Problem codes of failed jobs that are no fault of their photos. They are told of before there is one: Prometheus sees
no increase in a counter that appears with its first count."""

_FROM_ZERO: dict[str, tuple[tuple[str, ...], ...]] = {
    totals.JOBS_ENDED.name: (
        ("succeeded", ""),
        ("cancelled", ""),
        *(("failed", code) for code in SERVICE_FAULTS),
    ),
    totals.WORKERS_LOST.name: (("waiting",), ("failed",)),
    totals.ATTEMPT_CPU.name: ((),),
}


@dataclass(frozen=True)
class RedisValues:
    """The values in Redis at a scrape.

    now: time by the clock of Redis, seconds since 1970.
    waiting: what waits in the queue.
    oldest: time since which the entry waits that has waited longest; None if none waits.
    listening: the workers that listen or work.
    memory: the memory of Redis.
    counted: what was counted, by the name of the total.
    records: number of captures, jobs and models.
    unfinished: number of jobs that have not ended.
    stored: bytes that all owners hold in storage, as of the last scan and what has come since.
    scanned: time at which the last scan of storage ended; None before the first one.
    """

    now: float
    waiting: Waiting
    oldest: float | None
    listening: Sequence[WorkerRecord]
    memory: RedisMemory
    counted: Mapping[str, Counted]
    records: Mapping[str, int]
    unfinished: int
    stored: int
    scanned: float | None


def read(connection: redis.Redis) -> RedisValues:
    """Return the values in Redis, in one round trip, and one more for the workers. Raises redis.RedisError."""
    with connection.pipeline(transaction=False) as pipe:
        pipe.time()
        lines.ask(pipe)
        pipe.zrange(keys.ARRIVED, 0, 0, withscores=True)
        pipe.smembers(rq_keys.WORKERS)
        pipe.info("memory")
        pipe.hgetall(keys.TOTALS)
        for kind in _KINDS:
            pipe.zcard(lists.name(kind))
        pipe.scard(keys.ACTIVE)
        pipe.hvals(keys.STORED_TOTALS)
        pipe.hget(keys.SCAN, "ended")
        replies = pipe.execute()
    (seconds, micros), waiting, oldest, known, info, stored_totals, *counts, active, held, scanned = replies
    return RedisValues(
        now=seconds + micros / 1e6,
        waiting=lines.answered(waiting),
        oldest=float(oldest[0][1]) if oldest else None,
        listening=workers.recorded(connection, known),
        memory=memory.of(info),
        counted=totals.read(stored_totals),
        records=dict(zip(_KINDS, counts, strict=True)),
        unfinished=int(active),
        stored=sum(map(int, held)),
        scanned=float(scanned) if scanned is not None else None,
    )


def families(values: RedisValues | None) -> Iterator[Metric]:
    """Yield the metrics, in which there are no values if Redis did not answer, but that it did not."""
    yield GaugeMetricFamily(
        "splatmill_redis_up", f"1 if Redis answers, else 0. {SMALLEST}", value=0 if values is None else 1
    )
    yield from _of_queue(values)
    yield from _of_workers(values)
    yield from _of_storage(values)
    yield from _of_redis(values)
    for total in totals.TOTALS:
        yield _family(total, values.counted[total.name] if values is not None else None)


def of_disk(spare: int | None) -> Iterator[Metric]:
    """Yield what is free on the disk of storage beyond its reserve, bytes; None: storage is a bucket."""
    yield GaugeMetricFamily(
        "splatmill_storage_spare_bytes",
        "Bytes that are free on the disk of storage beyond its reserve; at 0 uploads are refused. Not there for a "
        f"bucket. {SMALLEST}",
        value=spare,
    )


def of_renderer(state: RendererState | None) -> Iterator[Metric]:
    """Yield the metrics of the renderer; None: the server has none."""
    up = GaugeMetricFamily(
        "splatmill_renderer_up",
        f"1 if the renderer answers, else 0. Not there for a server without one. {SMALLEST}",
    )
    admitted = _gauge(
        "splatmill_renderer_admitted", "Requests that the renderer has in its queue or renders."
    )
    cached = _gauge("splatmill_renderer_cached_bytes", "Bytes of the models that the renderer has in memory.")
    if state is not None:
        answers = state.status == "ok"
        up.add_metric([], answers)
        if answers:
            admitted.add_metric([], state.admitted)
            cached.add_metric([], state.cached)
    yield from (up, admitted, cached)


def _of_queue(values: RedisValues | None) -> Iterator[Metric]:
    length = _gauge("splatmill_queue_length", "Jobs that wait for a worker.", "queue")
    serving = _gauge("splatmill_queue_workers", "Workers that serve a queue.", "queue")
    oldest = _gauge(
        "splatmill_queue_oldest_seconds",
        "Seconds that the job has waited which has waited longest; 0 if none waits.",
    )
    unfinished = _gauge("splatmill_jobs_unfinished", "Jobs that have not ended, those that wait among them.")
    if values is not None:
        for line in LINES:
            length.add_metric([line], values.waiting.count(line))
            serving.add_metric([line], len(workers.serving(values.listening, line)))
        oldest.add_metric([], 0.0 if values.oldest is None else max(0.0, values.now - values.oldest))
        unfinished.add_metric([], values.unfinished)
    yield from (length, serving, oldest, unfinished)


def _of_workers(values: RedisValues | None) -> Iterator[Metric]:
    states = _gauge(
        "splatmill_workers", "Registered workers: idle, busy, suspended (disk full), other.", "state"
    )
    age = _gauge(
        "splatmill_worker_heartbeat_age_seconds",
        "Seconds since the last heartbeat of the worker that was silent longest, by the clocks of both machines.",
    )
    spare = _gauge(
        "splatmill_worker_disk_spare_bytes",
        "Bytes that are free beyond the reserve on the disk of the worker that has least; at 0 it takes no jobs.",
    )
    if values is not None:
        counts = Counter(dict.fromkeys(_STATES, 0))
        counts.update(worker.state if worker.state in _STATES else "other" for worker in values.listening)
        for state, count in counts.items():
            states.add_metric([state], count)
        beats = [worker.last_heartbeat for worker in values.listening if worker.last_heartbeat is not None]
        if beats:
            age.add_metric([], max(0.0, values.now - min(beats).timestamp()))
        spares = [worker.spare for worker in values.listening if worker.spare is not None]
        if spares:
            spare.add_metric([], min(spares))
    yield from (states, age, spare)


def _of_storage(values: RedisValues | None) -> Iterator[Metric]:
    records = _gauge("splatmill_records", "Captures, jobs and models.", "kind")
    stored = _gauge(
        "splatmill_stored_bytes", "Bytes that all owners hold in storage, by the last scan of it."
    )
    scan = _gauge("splatmill_storage_scan_age_seconds", "Seconds since the last scan of storage ended.")
    if values is not None:
        for kind, count in values.records.items():
            records.add_metric([kind], count)
        stored.add_metric([], values.stored)
        if values.scanned is not None:
            scan.add_metric([], max(0.0, values.now - values.scanned))
    yield from (records, stored, scan)


def _of_redis(values: RedisValues | None) -> Iterator[Metric]:
    used = _gauge("splatmill_redis_memory_bytes", "Bytes of memory that Redis uses.")
    limit = _gauge(
        "splatmill_redis_memory_limit_bytes",
        "Bytes of memory at which Redis takes no more writes; 0 if there is no limit.",
    )
    if values is not None:
        used.add_metric([], values.memory.used)
        limit.add_metric([], values.memory.limit or 0)
    yield from (used, limit)


def _gauge(name: str, text: str, *labels: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, f"{text} {SAME}", labels=labels)


def _family(total: Total, counted: Counted | None) -> Metric:
    text = f"{total.text} {SAME}"
    if not total.bounds:
        counter = CounterMetricFamily(total.name, text, labels=total.labels)
        if counted is not None:
            zeros = dict.fromkeys(_FROM_ZERO.get(total.name, ()), 0.0)
            for labels, value in sorted((zeros | counted.values).items()):
                counter.add_metric(labels, value)
        return counter
    histogram = HistogramMetricFamily(total.name, text, labels=total.labels)
    if counted is None:
        return histogram
    for labels, distribution in sorted(counted.distributions.items(), key=lambda item: item[0]):
        histogram.add_metric(labels, _buckets(total, distribution), distribution.sum)
    return histogram


def _buckets(total: Total, distribution: Distribution) -> list[tuple[str, float]]:
    """Return the upper bound and the number of observations up to it, by bucket."""
    below, buckets = 0, []
    for bound, count in zip((*total.bounds, float("inf")), distribution.counts, strict=True):
        below += count
        buckets.append((str(float(bound)) if bound < float("inf") else "+Inf", float(below)))
    return buckets
