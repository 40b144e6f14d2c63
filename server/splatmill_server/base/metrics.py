"""Prometheus metrics of an API process. Each app has its own registry, so that two apps do not collide.

What each process counts for itself is to be added up. What all processes read from Redis (`scrape`) is the same in
each. The last sentence of each text says which.
"""

from collections.abc import Iterable, Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from splatmill.backplane.storage.storage import StorageError

MEDIA_TYPE = CONTENT_TYPE_LATEST

OF_PROCESS = "Of one API process: add them up."
SAME = "The same from every API process: take the largest."
SMALLEST = "As this API process sees it: take the smallest."

_METHODS = frozenset({"DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT"})
_OTHER = "other"

_FAST = (0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60)
_LONG = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 300, 900)


class Metrics:
    """Counters that this process increments, and the metrics that are read when it is scraped."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = self._counter(
            "splatmill_http_requests", "HTTP requests answered.", "method", "route", "status"
        )
        self.seconds = self._histogram(
            "splatmill_http_request_seconds",
            "Seconds until a response was complete (event streams: until they ended).",
            Histogram.DEFAULT_BUCKETS,
            "route",
        )
        self.uploaded = self._counter("splatmill_uploaded_bytes", "Bytes of uploaded files.")
        self.files = self._counter("splatmill_uploaded_files", "Files that were uploaded or imported.")
        self.created = self._counter("splatmill_jobs_created", "Jobs created.")
        self.ended = self._counter(
            "splatmill_jobs_given_up", "Jobs that the server ended because no worker did.", "code"
        )
        self.requeued = self._counter(
            "splatmill_jobs_requeued", "Jobs enqueued again because the queue had lost them."
        )
        self.streams = Gauge(
            "splatmill_event_streams", f"Open event streams. {OF_PROCESS}", registry=self.registry
        )
        self.storage_operations = self._counter(
            "splatmill_storage_operations",
            "Operations on storage, by what was done (read, write, list, delete) and the result: ok, full, stalled, "
            "unreachable, busy, changed or failed. What is repeated after a break counts each time.",
            "operation",
            "result",
        )
        self.storage_seconds = self._histogram(
            "splatmill_storage_seconds",
            "Seconds of an operation on storage, that of an upload or download with its client.",
            _FAST,
            "operation",
        )
        self.webhook_attempts = self._counter(
            "splatmill_webhook_attempts",
            "Attempts to deliver to a webhook, by result: delivered, retried (there will be another) or failed (given "
            "up).",
            "result",
        )
        self.webhooks_waiting = Gauge(
            "splatmill_webhook_deliveries_waiting",
            f"Deliveries to webhooks that wait for an attempt, those to be repeated later among them. {SAME}",
            registry=self.registry,
        )
        self.renders = self._counter(
            "splatmill_renders",
            "Requests to the renderer, by kind (render, orbit, frames and join of a kept orbit, convert, edits, mesh) "
            "and result: made, not_modified, refused (its queue is full), abandoned (the client has left), timeout, "
            "unreachable or failed.",
            "kind",
            "result",
        )
        self.render_seconds = self._histogram(
            "splatmill_render_seconds",
            "Seconds until the renderer answered with what was asked for, its queue included.",
            _LONG,
            "kind",
        )

    def request(self, method: str, route: str | None, status: int, seconds: float) -> None:
        """Count an answered request. A method that no endpoint has, and a path of no route, count as `other`."""
        named = route if route is not None else _OTHER
        self.requests.labels(method if method in _METHODS else _OTHER, named, str(status)).inc()
        self.seconds.labels(named).observe(seconds)

    def storage_operation(self, verb: str, seconds: float, error: StorageError | None) -> None:
        """Count an operation on storage (`Storage.watch`)."""
        result = "ok" if error is None else error.kind
        self.storage_operations.labels(verb, result).inc()
        self.storage_seconds.labels(verb).observe(seconds)

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(name, f"{text} {OF_PROCESS}", labels, registry=self.registry)

    def _histogram(self, name: str, text: str, buckets: Iterable[float], *labels: str) -> Histogram:
        return Histogram(name, f"{text} {OF_PROCESS}", labels, buckets=tuple(buckets), registry=self.registry)

    def text(self, scraped: Iterable[Metric]) -> bytes:
        """Return the metrics in the text format of Prometheus, with those that were read for this scrape."""
        return generate_latest(_Joined([*self.registry.collect(), *scraped]))


class _Joined(Collector):
    """Metrics of several sources."""

    def __init__(self, metrics: list[Metric]) -> None:
        self._metrics = metrics

    def collect(self) -> Iterator[Metric]:
        yield from self._metrics
