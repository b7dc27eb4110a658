"""Main program of the front end; run with ``python -m`` and the link's descriptor."""

from __future__ import annotations

import logging
import resource

import estimator.bounded_files  # noqa: F401  read now: later no file may be opened
from filter_service.service.front_end import FrontEnd
from filter_service.service.metrics import NoMetrics
from filter_service.service.process_startup import begin

MB = 10**6

log = logging.getLogger("ocufilter")


def main() -> None:
    """Serve clients until the supervisor sends stop."""
    supervisor, config, others = begin("front-end")
    # Parts of incomplete messages are invisible here.  Beyond the limit libzmq ends the
    # process, which frees its memory; sessions continue.
    limit = config.max_socket_mb * MB
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    except (OSError, ValueError) as error:
        log.warning("max_socket_mb has no effect on this system: %s", error)
    try:
        front_end = FrontEnd(config, supervisor)
    except (OSError, NoMetrics) as error:
        supervisor.send(("failed", str(error)))
        raise SystemExit(1) from None
    supervisor.send(("ready", front_end.endpoint))
    for message, descriptors in others:
        front_end.take_control(message, descriptors)
    front_end.run()


if __name__ == "__main__":
    main()
