"""`ocufilter serve`, or ``python -m filter_service``: run the service."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from filter_service import one_blas_thread  # noqa: F401  (before any numpy)
from filter_service.command_line import EXIT_BAD_INPUT, app_of, run
from filter_service.settings import Engine


def serve(
    bind: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Endpoint to listen on: tcp://127.0.0.1:5577 or ipc:///tmp/ocufilter.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Configuration file.")
    ] = None,
    engine: Annotated[
        Engine | None,
        typer.Option(
            help="gl: shaders; native: compiled C; auto: gl if there is a GPU."
        ),
    ] = None,
    gl_device: Annotated[
        str | None,
        typer.Option(
            metavar="INDEX",
            help="Index of the EGL device, as listed by `doctor`; or auto.",
        ),
    ] = None,
    devices: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="A render process for each device: gl:0,gl:1 or native:4,native:4.",
        ),
    ] = None,
    keep_eyes: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder in which finished eyes are cached for the next start; see "
            "`ocufilter eyes`.",
        ),
    ] = None,
    ready_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File that receives the endpoint once the service is ready.",
        ),
    ] = None,
) -> None:
    """Filter frames for clients until interrupted.

    filter_service/PROTOCOL.md describes the messages.  --bind overrides the
    configuration file.  SIGHUP reloads the file's limits and timeouts without
    interrupting the service.

    ocufilter serve --bind tcp://127.0.0.1:5577
    """
    from filter_service.service.config import load_config
    from filter_service.service.supervisor import run as run_service

    if config is not None and not config.is_file():
        raise ValueError(f"--config '{config}': no such file")
    load = partial(
        load_config,
        config,
        bind=bind,
        engine=engine,
        gl_device=gl_device,
        devices=devices,
        ready_file=ready_file,
        store_cache_dir=None if keep_eyes is None else str(keep_eyes.absolute()),
    )
    run_service(load(), reload_config=load)


def main() -> None:
    """Run `ocufilter serve` without importing the client package.

    python -m filter_service serve --bind tcp://127.0.0.1:5577
    """
    match sys.argv[1:]:
        case ["serve", *_]:
            del sys.argv[1]
        case [word, *_] if not word.startswith("-"):
            sys.stderr.write(
                f"python -m filter_service: unknown command '{word:.60}'; allowed: "
                "serve; for other commands, use `ocufilter` or `python -m ocufilter`\n"
            )
            sys.exit(EXIT_BAD_INPUT)
    run(app_of(serve), "python -m filter_service")
