"""The metrics of the service, from `splatmill_server.base.metrics` and `splatmill_server.base.scrape`."""

from typing import Any

from docs.generate.markdown import choices, code, table
from prometheus_client.metrics_core import Metric

from splatmill.backplane.totals import TOTALS
from splatmill_server.base.metrics import OF_PROCESS, SAME, SMALLEST, Metrics
from splatmill_server.base.scrape import families, of_disk, of_renderer

INTRODUCTION = """# Metrics

All metrics in `GET /metrics` of an API process, generated from the program. Where there are several processes,
the last column says how their values are put together: `sum` for what each counts for itself, `max` or `min` for what
each reads from the same place, so that adding would count it several times. Counters and histograms that all
processes share are in Redis. One that comes back empty begins at zero, as a counter of a restarted process does.
"""

_TOGETHER = {OF_PROCESS: "sum", SAME: "max", SMALLEST: "min"}


def metrics() -> list[Metric]:
    """Every family of metrics that an API process has, by name."""
    all_of_them = [*Metrics().registry.collect(), *families(None), *of_disk(None), *of_renderer(None)]
    return sorted(all_of_them, key=lambda family: family.name)


def names() -> dict[str, str]:
    """The name of each metric as it is asked for, and how the values of several processes are put together."""
    return {_name(family): _together(family)[1] for family in metrics()}


def page() -> str:
    """The page of metrics."""
    rows = [
        [code(_name(family)), family.type, choices(_labels(family)), *_together(family)]
        for family in metrics()
    ]
    return f"{INTRODUCTION}\n{table(['metric', 'type', 'labels', 'meaning', 'processes'], rows)}"


def _name(family: Metric) -> str:
    return f"{family.name}_total" if family.type == "counter" else family.name


def _labels(family: Metric) -> tuple[str, ...]:
    shared = {total.name: total.labels for total in TOTALS}
    own = {
        metric._name: metric._labelnames
        for metric in vars(Metrics()).values()
        if hasattr(metric, "_labelnames")
    }
    labels: Any = shared.get(family.name) or own.get(family.name) or getattr(family, "_labelnames", ())
    return tuple(labels)


def _together(family: Metric) -> tuple[str, str]:
    text, rule = family.documentation, ""
    for sentence, word in _TOGETHER.items():
        if text.endswith(sentence):
            text, rule = text.removesuffix(sentence).strip(), word
    return text, rule
