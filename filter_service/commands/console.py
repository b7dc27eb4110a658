"""What all commands share: where output goes, errors, progress."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from filter_service.progress import Progress

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object and nothing else.")
]


class CommandFailed(Exception):
    """A failure the user can read: one line on stderr, exit code 1."""


def say(line: str = "") -> None:
    """Print one line of the report."""
    sys.stdout.write(line + "\n")


def print_json(data: dict) -> None:
    """Print the one JSON object of a ``--json`` run."""
    say(json.dumps(data, allow_nan=False))


def check_range(option: str, value: float, limits: tuple[float, float]) -> None:
    """Refuse a number outside ``limits``, or that is none.

    Raises
    ------
    ValueError
        Names the option, the value and the range.
    """
    low, high = limits
    if not low <= value <= high:
        raise ValueError(f"{option} {value:g}: allowed is {low:g} to {high:g}")


@contextmanager
def progress_bar(title: str, *, quiet: bool) -> Iterator[Callable[[float, str], None]]:
    """Give a function (fraction, stage) that says on stderr how far work is.

    A bar on a terminal, now and then a line elsewhere; nothing when ``quiet``.
    """
    with Progress(quiet=quiet) as progress:
        task = progress.task(title, total=1.0, unit="%")
        yield task.update
