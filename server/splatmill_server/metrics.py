"""Prometheus metrics of an API process. Each app has its own registry, so that two apps do not collide."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

MEDIA_TYPE = CONTENT_TYPE_LATEST


class Metrics:
    """Counters that the endpoints increment, and gauges that are set when the metrics are scraped."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "splatmill_http_requests",
            "HTTP requests answered.",
            ["method", "route", "status"],
            registry=self.registry,
        )
        self.seconds = Histogram(
            "splatmill_http_request_seconds",
            "Seconds until a response was complete (event streams: until they ended).",
            ["route"],
            registry=self.registry,
        )
        self.uploaded = Counter(
            "splatmill_uploaded_bytes", "Bytes of uploaded files.", registry=self.registry
        )
        self.created = Counter("splatmill_jobs_created", "Jobs created.", registry=self.registry)
        self.ended = Counter(
            "splatmill_jobs_given_up",
            "Jobs that this process ended because no worker did.",
            ["code"],
            registry=self.registry,
        )
        self.requeued = Counter(
            "splatmill_jobs_requeued",
            "Jobs enqueued again because the queue had lost them.",
            registry=self.registry,
        )
        self.streams = Gauge("splatmill_event_streams", "Open event streams.", registry=self.registry)
        self.waiting = Gauge(
            "splatmill_queue_length", "Jobs that wait for a worker.", ["queue"], registry=self.registry
        )
        self.serving = Gauge(
            "splatmill_queue_workers", "Workers that serve a queue.", ["queue"], registry=self.registry
        )
        self.workers = Gauge("splatmill_workers", "Registered workers.", ["state"], registry=self.registry)
        self.redis_up = Gauge("splatmill_redis_up", "1 if Redis answers, else 0.", registry=self.registry)
        self.redis_memory = Gauge(
            "splatmill_redis_memory_bytes", "Bytes of memory that Redis uses.", registry=self.registry
        )
        self.redis_limit = Gauge(
            "splatmill_redis_memory_limit_bytes",
            "Bytes of memory at which Redis takes no more writes; 0 if there is no limit.",
            registry=self.registry,
        )

    def text(self) -> bytes:
        """Return the metrics in the text format of Prometheus."""
        return generate_latest(self.registry)
