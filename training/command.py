"""Common parts of the training commands: help, and errors in one line."""

import argparse
import sys
from collections.abc import Callable

from training.datasets import DataError
from training.run_file import RunFileError


def make_parser(module: str, documentation: str) -> argparse.ArgumentParser:
    """Return the parser of ``python -m training.<module>``; help is its docstring."""
    return argparse.ArgumentParser(
        prog=f"python -m training.{module}",
        description=documentation,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def run_command(
    parser: argparse.ArgumentParser,
    work: Callable[[argparse.Namespace], None],
    arguments: list[str] | None,
) -> int:
    """Run a command; return the exit code, 2 for errors in data or run files.

    ``arguments`` defaults to the command line.
    """
    options = parser.parse_args(arguments)
    try:
        work(options)
    except (DataError, RunFileError) as error:
        print(f"{parser.prog.rpartition('.')[2]}: {error}", file=sys.stderr)
        return 2
    return 0
