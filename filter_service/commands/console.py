"""What all commands share: where output goes, errors, progress."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

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
    """Give a function (fraction, stage) that draws a bar on stderr, if a person looks.

    Nothing is drawn when ``quiet`` or when stderr is not a terminal.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda fraction, stage: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda fraction, stage: progress.update(
            task, completed=fraction, description=f"{title}: {stage}"
        )
