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
    """A failure reported to the user: one line on stderr, exit code 1."""


def say(line: str = "") -> None:
    """Print one line of the report."""
    sys.stdout.write(line + "\n")


def print_json(data: dict[str, Any]) -> None:
    """Print the one JSON object of a ``--json`` run."""
    say(json.dumps(data, allow_nan=False))


def check_range(option: str, value: float, limits: tuple[float, float]) -> None:
    """Check that a number is within ``limits`` and not NaN.

    Raises
    ------
    ValueError
        If it is not; the message names the option, the value and the range.
    """
    low, high = limits
    if not low <= value <= high:
        raise ValueError(f"{option} {value:g}: allowed is {low:g} to {high:g}")


@contextmanager
def progress_bar(title: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Yield a function (fraction, stage) that reports progress on stderr.

    It draws a bar on a terminal and prints occasional lines elsewhere; with ``quiet``
    it prints nothing.
    """
    with Progress(quiet=quiet) as progress:
        task = progress.task(title, total=1.0, unit="%")
        yield task.update
