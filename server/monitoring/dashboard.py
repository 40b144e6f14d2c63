"""The text of `dashboard.json`, the Grafana dashboard of the service. `make generated` writes it.

It is built from Grafana's own types, so that mypy checks its fields. A metric that all API processes tell alike is
aggregated by `max`, one that each counts for itself by `sum` (docs/generate/metrics.py lists which is which).
"""

import json

from grafana_foundation_sdk.builders import common, dashboard, prometheus, stat, timeseries
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.common import DataSourceRef

_SOURCE = DataSourceRef(type_val="prometheus", uid="${source}")
_HEIGHT, _WIDTH = 8, 8


def quantile(share: float, name: str, together: str, *labels: str, only: str = "") -> str:
    """Return a query of a quantile of a histogram, by labels."""
    by = ", ".join(("le", *labels))
    return f"histogram_quantile({share}, {together} by ({by}) (rate({name}_bucket{only}[$__rate_interval])))"


def rate(name: str, together: str, *labels: str, only: str = "") -> str:
    """Return a query of the increase of a counter per second, by labels."""
    return f"{together} by ({', '.join(labels)}) (rate({name}{only}[$__rate_interval]))"


def lines(title: str, unit: str, text: str, **queries: str) -> timeseries.Panel:
    """Return a panel of lines over time. queries: by legend, in which `__label` stands for the value of a label."""
    panel = timeseries.Panel().title(title).description(text).unit(unit).min(0).datasource(_SOURCE)
    panel = panel.height(_HEIGHT).span(_WIDTH).fill_opacity(10)
    for number, (legend, query) in enumerate(queries.items()):
        words = [f"{{{{{word[2:]}}}}}" if word.startswith("__") else word for word in legend.split()]
        panel = panel.with_target(_query(query, " ".join(words), number))
    return panel


def figure(title: str, unit: str, text: str, query: str) -> stat.Panel:
    """Return a panel with one number: the newest one."""
    panel = stat.Panel().title(title).description(text).unit(unit).datasource(_SOURCE).height(4).span(4)
    panel = panel.reduce_options(common.ReduceDataOptions().calcs(["lastNotNull"]))
    return panel.with_target(_query(query, title, 0))


def _query(query: str, legend: str, number: int) -> prometheus.Dataquery:
    return prometheus.Dataquery().expr(query).legend_format(legend).ref_id(chr(ord("A") + number))


def build() -> dashboard.Dashboard:
    """Return the dashboard."""
    source = dashboard.DatasourceVariable("source").label("Prometheus").type("prometheus")
    board = dashboard.Dashboard("Splatmill").uid("splatmill").tags(["splatmill"]).refresh("30s")
    board = board.time("now-6h", "now").timezone("browser").with_variable(source)
    board = board.with_row(dashboard.Row("Now"))
    for panel in (
        figure("API processes", "none", "Those that are scraped and answer.", 'sum(up{job="splatmill"})'),
        figure("Jobs waiting", "none", "In all queues.", "sum(max by (queue) (splatmill_queue_length))"),
        figure("Waits longest", "s", "The oldest job in the queue.", "max(splatmill_queue_oldest_seconds)"),
        figure("Workers", "none", "Idle, busy and suspended.", "sum(max by (state) (splatmill_workers))"),
        figure("In storage", "bytes", "All owners together.", "max(splatmill_stored_bytes)"),
        figure(
            "Redis memory",
            "percentunit",
            "Share of maxmemory; no value without a limit.",
            "max(splatmill_redis_memory_bytes) / (max(splatmill_redis_memory_limit_bytes) > 0)",
        ),
    ):
        board = board.with_panel(panel)
    board = board.with_row(dashboard.Row("Jobs"))
    for lined in (
        lines(
            "Jobs that ended, in an hour",
            "none",
            "By outcome; the failed ones by problem code.",
            **{
                "__state __code": "max by (state, code) (increase(splatmill_jobs_ended_total[1h])) > 0",
            },
        ),
        lines(
            "Wait in the queue",
            "s",
            "Until a worker took the job.",
            **{
                "median __queue": quantile(0.5, "splatmill_queue_wait_seconds", "max", "queue"),
                "p95 __queue": quantile(0.95, "splatmill_queue_wait_seconds", "max", "queue"),
            },
        ),
        lines(
            "Seconds of a stage",
            "s",
            "Median of the jobs that ended.",
            __stage=quantile(0.5, "splatmill_stage_seconds", "max", "stage"),
        ),
        lines(
            "From order to end",
            "s",
            "Of jobs that ended with a model.",
            median=quantile(0.5, "splatmill_job_seconds", "max", only='{state="succeeded"}'),
            p95=quantile(0.95, "splatmill_job_seconds", "max", only='{state="succeeded"}'),
        ),
        lines(
            "Queues",
            "none",
            "Jobs that wait, and jobs that have not ended.",
            **{
                "waiting __queue": "max by (queue) (splatmill_queue_length)",
                "unfinished": "max(splatmill_jobs_unfinished)",
            },
        ),
        lines(
            "Created and repaired, in an hour",
            "none",
            "Jobs that were created, that the queue had lost, and that the server ended itself.",
            **{
                "created": "sum(increase(splatmill_jobs_created_total[1h]))",
                "requeued": "sum(increase(splatmill_jobs_requeued_total[1h]))",
                "given up": "sum(increase(splatmill_jobs_given_up_total[1h]))",
            },
        ),
    ):
        board = board.with_panel(lined)
    board = board.with_row(dashboard.Row("Workers"))
    for lined in (
        lines(
            "Workers by state",
            "none",
            "Suspended: the disk is full but for the reserve.",
            **{
                "__state": "max by (state) (splatmill_workers)",
                "serve __queue": "max by (queue) (splatmill_queue_workers)",
            },
        ),
        lines(
            "Attempts that ended, in an hour",
            "none",
            "By how they ended, and workers that were lost with one.",
            **{
                "__end": "max by (end) (increase(splatmill_attempts_total[1h]))",
                "lost, entry __entry": "max by (entry) (increase(splatmill_workers_lost_total[1h]))",
            },
        ),
        lines(
            "Processors in use",
            "none",
            "Processor seconds per second of the attempts that ended, over an hour.",
            cores="max(rate(splatmill_attempt_cpu_seconds_total[1h]))",
        ),
        lines(
            "Silence of the most silent worker",
            "s",
            "Since its last heartbeat.",
            seconds="max(splatmill_worker_heartbeat_age_seconds)",
        ),
        lines(
            "Free beyond the reserve",
            "bytes",
            "On the disk of the fullest worker, and of a storage folder.",
            worker="max(splatmill_worker_disk_spare_bytes)",
            storage="min(splatmill_storage_spare_bytes)",
        ),
    ):
        board = board.with_panel(lined)
    board = board.with_row(dashboard.Row("Requests"))
    for lined in (
        lines(
            "Requests a second",
            "reqps",
            "By status.",
            __status=rate("splatmill_http_requests_total", "sum", "status"),
        ),
        lines(
            "Seconds of a request",
            "s",
            "The slowest routes, 95% of their requests; without event streams.",
            __route="topk(8, "
            + quantile(
                0.95, "splatmill_http_request_seconds", "sum", "route", only='{route!~".*/(events|live)"}'
            )
            + ")",
        ),
        lines(
            "Uploads and followers",
            "none",
            "Files a minute, and open event streams.",
            **{
                "files a minute": "60 * sum(rate(splatmill_uploaded_files_total[$__rate_interval]))",
                "event streams": "sum(splatmill_event_streams)",
            },
        ),
        lines(
            "Bytes uploaded",
            "Bps",
            "A second.",
            uploads="sum(rate(splatmill_uploaded_bytes_total[$__rate_interval]))",
        ),
        lines(
            "Webhooks",
            "none",
            "Attempts in an hour by result, and deliveries that wait.",
            __result="sum by (result) (increase(splatmill_webhook_attempts_total[1h]))",
            waiting="max(splatmill_webhook_deliveries_waiting)",
        ),
    ):
        board = board.with_panel(lined)
    board = board.with_row(dashboard.Row("Pictures"))
    for lined in (
        lines(
            "Renders a second",
            "reqps",
            "By result.",
            __result=rate("splatmill_renders_total", "sum", "result"),
        ),
        lines(
            "Seconds of a render",
            "s",
            "95% of them, the queue of the renderer included.",
            __kind=quantile(0.95, "splatmill_render_seconds", "sum", "kind"),
        ),
        lines(
            "Queue of the renderer",
            "none",
            "Requests that wait or are rendered.",
            requests="max(splatmill_renderer_admitted)",
            answers="min(splatmill_renderer_up)",
        ),
        lines(
            "Models in the renderer",
            "bytes",
            "Bytes in memory.",
            models="max(splatmill_renderer_cached_bytes)",
        ),
    ):
        board = board.with_panel(lined)
    board = board.with_row(dashboard.Row("Storage and Redis"))
    for lined in (
        lines(
            "Operations on storage",
            "ops",
            "By what was done.",
            __operation=rate("splatmill_storage_operations_total", "sum", "operation"),
        ),
        lines(
            "Errors of storage",
            "ops",
            "By what happened.",
            __result=rate("splatmill_storage_operations_total", "sum", "result", only='{result!="ok"}'),
        ),
        lines(
            "Seconds of an operation",
            "s",
            "95% of them.",
            __operation=quantile(0.95, "splatmill_storage_seconds", "sum", "operation"),
        ),
        lines(
            "What there is",
            "none",
            "Captures, jobs and models.",
            __kind="max by (kind) (splatmill_records)",
        ),
        lines(
            "Bytes held",
            "bytes",
            "In storage by all owners, and by Redis.",
            storage="max(splatmill_stored_bytes)",
            Redis="max(splatmill_redis_memory_bytes)",
        ),
        lines(
            "Redis and scans",
            "s",
            "Seconds since storage was scanned; Redis answers: 1.",
            **{
                "since the scan": "max(splatmill_storage_scan_age_seconds)",
                "Redis answers": "min(splatmill_redis_up)",
            },
        ),
    ):
        board = board.with_panel(lined)
    return board


def text() -> str:
    """Return the dashboard as it is imported into Grafana."""
    built = build().build()
    for number, panel in enumerate(built.panels or [], start=1):
        panel.id_val = number
    return json.dumps(json.loads(JSONEncoder().encode(built)), indent=1, sort_keys=True) + "\n"
