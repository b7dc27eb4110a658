"""Metrics of the service in the Prometheus format, on a loopback port."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

HOST = "127.0.0.1"
REQUEST_LIMIT_S = 1.0

METRICS = {
    # name: description; a suffix _total marks a counter
    "ocufilter_ready": "1 while frames can be filtered",
    "ocufilter_degraded": "1 while a process keeps exiting or a device is unavailable",
    "ocufilter_connections": "open connections, with a session or without",
    "ocufilter_connections_evicted_total": "connections closed beyond the limit",
    "ocufilter_sessions": "sessions with a client",
    "ocufilter_sessions_away": "sessions whose client disconnected and may resume",
    "ocufilter_frames_filtered_total": "frames that were filtered",
    "ocufilter_frames_dropped_total": "frames that were dropped or failed",
    "ocufilter_filter_seconds_total": "time spent on filtering frames",
    "ocufilter_messages_unheard_total": "messages ignored because of the rate limit",
    "ocufilter_faults_total": "unexpected errors of the service",
    "ocufilter_memory_bytes": "memory of the front end and the render workers",
    "ocufilter_psfs_bytes": "part of it that is used by PSFs",
    "ocufilter_render_silent_seconds": "time since the last worker heartbeat",
}


class MetricsUnavailable(Exception):
    """The Prometheus client is not installed, or the port is in use."""


def serve_metrics(port: int, values: Callable[[], dict[str, float]]) -> Any:
    """Serve the values of `METRICS` in a thread; return the server.

    Parameters
    ----------
    port : int
        Port on 127.0.0.1.
    values : callable
        Returns the current values by name; called from the thread.

    Raises
    ------
    MetricsUnavailable
        If prometheus-client is not installed, or the port is in use.
    """
    try:
        from wsgiref.simple_server import WSGIRequestHandler, make_server

        from prometheus_client import CollectorRegistry, make_wsgi_app
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
    except ImportError:
        raise MetricsUnavailable(
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

    class Handler(WSGIRequestHandler):
        timeout = REQUEST_LIMIT_S

        def log_message(self, format: str, *args: Any) -> None:
            """Do not log requests."""

    registry = CollectorRegistry()
    registry.register(Collector())
    try:
        # One request at a time, each with a time limit: with a thread per connection,
        # anyone who connects could use up descriptors and memory.
        server = make_server(HOST, port, make_wsgi_app(registry), handler_class=Handler)
    except OSError as error:
        raise MetricsUnavailable(f"metrics_port is {port}: {error.strerror}") from None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
