"""Starts the real service loop with the doubles: ``python -m`` this, with --config."""

import argparse
import logging
from pathlib import Path

from filter_service.building.worker_handle import WorkerHandle
from filter_service.filtering.workshop import Workshop
from filter_service.service.config import load_config
from filter_service.service.launch import serve
from tests.end_to_end.doubles import EngineDouble, read_profile


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--filter-ms", type=float, default=0.0)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    config = load_config(arguments.config)
    build = "tests.end_to_end.doubles:build"
    worker = WorkerHandle(
        build, config.build_niceness, config.cancel_grace_s, warm_up=""
    )
    engine = EngineDouble(arguments.filter_ms)
    workshop = Workshop(worker, engine, config.build_limits)
    serve(config, workshop=workshop, read_profile=read_profile)


if __name__ == "__main__":
    main()
