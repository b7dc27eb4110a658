"""Main program of the front end; run with ``python -m`` and the link's descriptor."""

from __future__ import annotations

import logging
import resource

import estimator.bounded_files  # noqa: F401  read now: later no file may be opened
from filter_service.service.child import begin
from filter_service.service.door import Door
from filter_service.service.metrics import NoMetrics

MB = 10**6

log = logging.getLogger("ocufilter")


def main() -> None:
    """Serve clients until the supervisor sends stop."""
    keeper, config, others = begin("door")
    # Parts of incomplete messages are invisible here.  Beyond the limit libzmq ends the
    # process, which frees its memory; sessions continue.
    limit = config.max_socket_mb * MB
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    except (OSError, ValueError) as error:
        log.warning("max_socket_mb is not kept to on this system: %s", error)
    try:
        door = Door(config, keeper)
    except (OSError, NoMetrics) as error:
        keeper.send(("failed", str(error)))
        raise SystemExit(1) from None
    keeper.send(("ready", door.endpoint))
    for message, descriptors in others:
        door.take_control(message, descriptors)
    door.run()


if __name__ == "__main__":
    main()
