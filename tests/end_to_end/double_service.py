"""Starts the real service with the doubles: ``python -m`` this, with --config."""

import argparse
import os
from functools import partial
from pathlib import Path

from filter_service.errors import RenderFailed
from filter_service.service import supervisor
from filter_service.service.config import load_config
from filter_service.service.supervisor import run

FILTER_MS = "OCUFILTER_TEST_FILTER_MS"
GONE_FILE = "OCUFILTER_TEST_GONE_FILE"
"""While there is a file of that name, a device of two threads cannot be started."""

STANDBY_AFTER_S = "OCUFILTER_TEST_STANDBY_AFTER_S"


def open_builder(config, closing):
    """Import what frames need in the render process alone: a start is 0.2 s shorter."""
    from filter_service.building.worker_handle import WorkerHandle
    from filter_service.filtering.builder import Builder
    from tests.end_to_end.doubles import EngineDouble, read_profile

    gone = os.environ.get(GONE_FILE)
    if gone and config.threads == 2 and Path(gone).exists():
        raise RenderFailed("the double has no such device")
    worker = WorkerHandle(
        "tests.end_to_end.doubles:build",
        config.cancel_grace_s,
        config.build_limit_s,
    )
    closing.callback(worker.close)
    engine = EngineDouble(float(os.environ[FILTER_MS]))
    builder = Builder(worker, engine, config.build_limits)
    return builder, read_profile, lambda: None


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--filter-ms", type=float, default=0.0)
    arguments = parser.parse_args()
    os.environ[FILTER_MS] = str(arguments.filter_ms)
    after_s = os.environ.get(STANDBY_AFTER_S)
    if after_s is not None:
        supervisor.STANDBY_AFTER_S = float(after_s)
    load = partial(load_config, arguments.config)
    run(
        load(),
        open_builder="tests.end_to_end.double_service:open_builder",
        reload_config=load,
    )


if __name__ == "__main__":
    main()
