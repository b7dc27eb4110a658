"""Counters of the service in Prometheus' format, on a port of this machine alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

HOST = "127.0.0.1"

METRICS = {
    # name: what it is; those in _total only grow
    "ocufilter_ready": "1 while frames can be filtered",
    "ocufilter_sessions": "sessions with a client",
    "ocufilter_sessions_away": "sessions whose client is gone and may come back",
    "ocufilter_frames_filtered_total": "frames answered with a picture",
    "ocufilter_frames_dropped_total": "frames answered without",
    "ocufilter_filter_seconds_total": "time in which frames were filtered",
    "ocufilter_messages_unheard_total": "messages of clients that sent too many wrong",
    "ocufilter_faults_total": "faults of the service that nobody foresaw",
    "ocufilter_memory_bytes": "memory of the door and the process that filters",
    "ocufilter_psfs_bytes": "of that, the PSFs of all clients",
    "ocufilter_render_silent_seconds": "since the last sign of life of what filters",
}


class NoMetrics(Exception):
    """What speaks Prometheus' format is not installed, or the port is taken."""


def serve_metrics(port: int, values: Callable[[], dict[str, float]]) -> Any:
    """Serve the values of `METRICS`, in a thread; return what ends it.

    Raises
    ------
    NoMetrics
    """
    try:
        from prometheus_client import CollectorRegistry, start_http_server
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
    except ImportError:
        raise NoMetrics(
            "metrics_port is set, but prometheus-client is not installed: "
            "pip install 'ocufilter[metrics]'"
        ) from None

    class Collector:
        def collect(self) -> Iterator[Any]:
            found = values()
            for name, text in METRICS.items():
                is_counter = name.endswith("_total")
                family = CounterMetricFamily if is_counter else GaugeMetricFamily
                yield family(name, text, value=found[name])

    registry = CollectorRegistry()
    registry.register(Collector())
    try:
        server, _ = start_http_server(port, addr=HOST, registry=registry)
    except OSError as error:
        raise NoMetrics(f"metrics_port is {port}: {error.strerror}") from None
    return server
