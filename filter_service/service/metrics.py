"""Metrics of the service in the Prometheus format, on a loopback port."""

from __future__ import annotations

import io
import logging
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

HOST = "127.0.0.1"
REQUEST_LIMIT_S = 1.0
"""Time after which a connection is closed, checked twice a second."""

MAX_CONNECTIONS = 16
"""Beyond them, the oldest connection is closed: a request takes milliseconds."""

MAX_HEAD_BYTES = 16_384

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
    "ocufilter_psf_tables_bytes": "part of it that is used by tables of PSFs",
    "ocufilter_frame_buffers_bytes": "buffers that frames reuse; gl: all on the GPU",
    "ocufilter_render_silent_seconds": "time since the last worker heartbeat",
}


log = logging.getLogger("ocufilter")


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
        from socketserver import ThreadingMixIn
        from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

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

    class Server(ThreadingMixIn, WSGIServer):
        """A thread per connection, so that a slow client delays no other one."""

        daemon_threads = True

        def __init__(self, *arguments: Any) -> None:
            self._opened_s: dict[socket.socket, float] = {}  # the oldest comes first
            super().__init__(*arguments)

        def process_request(self, request: Any, client_address: Any) -> None:
            """Start a thread for a connection; beyond the limit, close the oldest."""
            self._opened_s[request] = time.monotonic()
            for oldest in list(self._opened_s)[:-MAX_CONNECTIONS]:
                self._break(oldest)
            super().process_request(request, client_address)

        def service_actions(self) -> None:
            """Close connections that have exceeded the time limit."""
            expired_s = time.monotonic() - REQUEST_LIMIT_S
            for request, opened_s in list(self._opened_s.items()):
                if opened_s < expired_s:
                    self._break(request)

        def _break(self, request: socket.socket) -> None:
            """End all reads and writes of a connection, whose thread then closes it."""
            self._opened_s.pop(request, None)
            with suppress(OSError):  # already closed
                request.shutdown(socket.SHUT_RDWR)

        def shutdown_request(self, request: Any) -> None:
            """Close a connection."""
            self._opened_s.pop(request, None)
            super().shutdown_request(request)

        def handle_error(self, request: Any, client_address: Any) -> None:
            """Log an error, unless the connection ended."""
            if not isinstance(sys.exception(), OSError):
                log.exception("a request for metrics failed")

    class Handler(WSGIRequestHandler):
        def setup(self) -> None:
            """Read the head of the request, of limited size."""
            super().setup()
            head = b""
            while b"\r\n\r\n" not in head and len(head) < MAX_HEAD_BYTES:
                part = self.connection.recv(MAX_HEAD_BYTES - len(head))
                if not part:
                    break
                head += part
            self.rfile = io.BufferedReader(io.BytesIO(head))

        def log_message(self, format: str, *args: Any) -> None:
            """Do not log requests."""

    registry = CollectorRegistry()
    registry.register(Collector())
    application = make_wsgi_app(registry)
    try:
        server = make_server(HOST, port, application, Server, Handler)
    except OSError as error:
        raise MetricsUnavailable(f"metrics_port is {port}: {error.strerror}") from None
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
