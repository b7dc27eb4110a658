"""Programs that parse their own options."""

import importlib
from typing import Any

import typer

from filter_service.command_line import typer_app


def _program(module: str) -> typer.Typer:
    app = typer_app()

    @app.command(
        context_settings={
            "allow_extra_args": True,
            "ignore_unknown_options": True,
            "help_option_names": [],  # the program prints its own help
        }
    )
    def run(context: typer.Context) -> None:
        program: Any = importlib.import_module(module)
        if code := program.main(context.args):
            raise typer.Exit(code)

    return app


web = _program("clients.web.program")
