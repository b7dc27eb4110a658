"""Output, errors and progress, shared by all commands."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from filter_service.progress import Progress

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object and nothing else.")
]


class CommandFailed(Exception):
    """A failure that is reported in one line on stderr, with exit code 1."""


def print_line(line: str = "") -> None:
    """Print one line to stdout, with escapes for names that are not UTF-8."""
    sys.stdout.write(line.encode("utf-8", "backslashreplace").decode() + "\n")


def print_json(data: dict[str, Any]) -> None:
    """Print the JSON object of a ``--json`` run."""
    print_line(json.dumps(data, allow_nan=False))


@contextmanager
def progress_bar(title: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Report progress on stderr: a bar on a terminal, occasional lines elsewhere.

    Parameters
    ----------
    title : str
        Name of the task.
    quiet : bool
        Whether to print nothing.

    Yields
    ------
    callable
        Function of the completed fraction, 0 to 1, and the stage.
    """
    with Progress(quiet=quiet) as progress:
        task = progress.task(title, total=1.0, unit="%")
        yield task.update
