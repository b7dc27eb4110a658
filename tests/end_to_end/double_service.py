"""Starts the real service loop with the doubles: ``python -m`` this, with --config."""

import argparse
import logging
from pathlib import Path

from filter_service.service.config import load_config
from filter_service.service.serving import serve
from filter_service.service.worker_handle import WorkerHandle
from tests.end_to_end.doubles import RendererDouble, check_profile


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--filter-ms", type=float, default=0.0)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    config = load_config(arguments.config)
    build = "tests.end_to_end.doubles:build"
    serve(
        config,
        renderer=RendererDouble(arguments.filter_ms),
        worker=WorkerHandle(build, config.build_niceness, config.cancel_grace_s),
        check_profile=check_profile,
        gl_renderer="numpy double",
    )


if __name__ == "__main__":
    main()
