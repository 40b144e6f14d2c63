"""Prometheus metrics of one API process. Each app has a registry of its own, so two apps do not collide."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

MEDIA_TYPE = CONTENT_TYPE_LATEST


class Metrics:
    """Counters that the endpoints raise, and gauges that are read when they are scraped."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "splatmill_http_requests",
            "Requests answered.",
            ["method", "route", "status"],
            registry=self.registry,
        )
        self.seconds = Histogram(
            "splatmill_http_request_seconds",
            "Seconds until an answer was complete (event streams: until they ended).",
            ["route"],
            registry=self.registry,
        )
        self.uploaded = Counter("splatmill_uploaded_bytes", "Bytes of files stored.", registry=self.registry)
        self.created = Counter("splatmill_jobs_created", "Jobs created.", registry=self.registry)
        self.ended = Counter(
            "splatmill_jobs_given_up", "Jobs this process ended itself.", ["code"], registry=self.registry
        )
        self.requeued = Counter("splatmill_jobs_requeued", "Jobs the queue had lost.", registry=self.registry)
        self.streams = Gauge("splatmill_event_streams", "Event streams open now.", registry=self.registry)
        self.waiting = Gauge("splatmill_queue_length", "Jobs that wait.", ["queue"], registry=self.registry)
        self.workers = Gauge("splatmill_workers", "Workers registered.", ["state"], registry=self.registry)
        self.redis_up = Gauge("splatmill_redis_up", "1 when Redis answers.", registry=self.registry)

    def text(self) -> bytes:
        """Everything in Prometheus's text format."""
        return generate_latest(self.registry)
