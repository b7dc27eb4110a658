"""Main program of the front end: ``python -m`` with the link's descriptor."""

from __future__ import annotations

import logging
import resource

import estimator.bounded_files  # noqa: F401  (later, no descriptor may be free to read it)
from filter_service.service.front_end import FrontEnd
from filter_service.service.metrics import MetricsUnavailable
from filter_service.service.process_startup import start_process

MB = 10**6

log = logging.getLogger("ocufilter")


def main() -> None:
    """Serve clients until the supervisor sends stop."""
    supervisor, config, others = start_process("front-end")
    # libzmq does not report the size of incomplete messages.  Beyond the limit it
    # aborts the process, which frees the memory; sessions survive.
    limit = config.max_socket_mb * MB
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    except (OSError, ValueError) as error:
        log.warning("max_socket_mb has no effect on this system: %s", error)
    try:
        front_end = FrontEnd(config, supervisor)
    except (OSError, MetricsUnavailable) as error:
        supervisor.send(("failed", str(error)))
        raise SystemExit(1) from None
    supervisor.send(("ready", front_end.endpoint))
    front_end.run(others)


if __name__ == "__main__":
    main()
