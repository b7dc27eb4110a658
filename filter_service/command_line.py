"""What all commands share: how they start, print, report errors and check numbers.

A command is a function with typed arguments, from which typer makes options.  It raises
an error for `run` to print: ValueError for invalid input, `CommandFailed`, FilterError
or OSError for a failure.
"""

import io
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, NoReturn

import typer
from typer.exceptions import Abort, TyperException

EXIT_FAILURE = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object and nothing else.")
]

OTHER_UNITS = {
    # unit of an option: other units, and how many of the option's they are
    "mm": (("m", 1000.0), ("um", 0.001)),
    "nm": (("um", 1000.0), ("m", 1e9)),
    "m": (("mm", 0.001), ("cm", 0.01)),
    "deg": (("rad", 57.29577951308232),),
    "s": (("ms", 0.001),),
}
"""Units that people give by mistake, the likely ones first."""

UNITS = (*OTHER_UNITS, "dpt", "px", "hz", "ms", "arcmin", "mrad", "um")
_NUMBER_AND_UNIT = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d]{1,12}|°|%)\s*"
)
EXTRAS = {
    # package: extra of ocufilter that installs it
    **dict.fromkeys(("pyrender", "trimesh", "OpenGL"), "pyrender"),
    **dict.fromkeys(("nicegui", "fastapi", "uvicorn"), "web"),
    "glfw": "clients",
    "av": "batch",
    "ray": "batch-ray",
    "xr": "headset",
}

# endings of Typer's messages
_BOUND = re.compile(r"\b(great|less)\w* than or equal to (\S+)")
_CHOICES = re.compile(r"is not one of (.+?)\.?$")


class CommandFailed(Exception):
    """A failure that is reported in one line on stderr, with exit code 1."""


def typer_app(**settings: Any) -> typer.Typer:
    """Return an application whose help is plain text; `settings` are typer's."""
    return typer.Typer(
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        **settings,
    )


def app_of(command: Callable[..., None]) -> typer.Typer:
    """Return an application with one command."""
    app = typer_app()
    app.command()(command)
    return app


def run(app: typer.Typer, name: str) -> NoReturn:
    """Run a program; errors become one line on stderr and an exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        # otherwise a file whose name is not UTF-8 ends a finished command with an error
        sys.stdout.reconfigure(errors="backslashreplace")
    sys.exit(exit_code(app, sys.argv[1:], name))


def exit_code(app: typer.Typer, arguments: list[str], name: str) -> int:
    """Run a program with these arguments; return its exit code."""
    try:
        return app(arguments, prog_name=name, standalone_mode=False) or 0
    except (Abort, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    except Exception as error:
        if "--traceback" in arguments[:1]:
            raise
        from estimator.bounded_files import printable

        code, text = _code_and_text(error, arguments, name)
        sys.stderr.write(f"{name}: {printable(' '.join(text.split()))}\n")
        return code


def install_command(extra: str) -> str:
    """Return the command that installs an extra of ocufilter for this Python."""
    return f"{sys.executable} -m pip install 'ocufilter[{extra}]'"


def _code_and_text(
    error: Exception, arguments: list[str], name: str
) -> tuple[int, str]:
    from filter_service.errors import FilterError

    if isinstance(error, TyperException):
        return error.exit_code, _with_value(error, arguments)
    if isinstance(error, FilterError):
        return EXIT_BAD_INPUT if error.field else EXIT_FAILURE, str(error)
    if isinstance(error, CommandFailed):
        return EXIT_FAILURE, str(error)
    if isinstance(error, ValueError):  # invalid input, by convention
        return EXIT_BAD_INPUT, str(error)
    if isinstance(error, OSError):
        return EXIT_FAILURE, str(error)
    if isinstance(error, ModuleNotFoundError) and error.name:
        if extra := EXTRAS.get(error.name.partition(".")[0]):
            return EXIT_FAILURE, (
                f"the package {error.name} is not installed: {install_command(extra)}"
            )
    where = f" (see {name} --traceback ...)" if name == "ocufilter" else ""
    return EXIT_FAILURE, f"{type(error).__name__}: {error}{where}"


def _with_value(error: TyperException, arguments: list[str]) -> str:
    """Return the message of an error in our form; Typer's may not name the value."""
    text = error.format_message()
    options: list[str] = getattr(getattr(error, "param", None), "opts", [])
    value = given_value(options, arguments)
    if value is None:
        return text
    if found := _BOUND.search(text):
        allowed = f"{found[2]} or {'more' if found[1] == 'great' else 'less'}"
    elif found := _CHOICES.search(text):
        allowed = found[1].replace("'", "")
    elif "valid integer" in text:
        allowed = "an integer"
    elif "valid number" in text:
        return f"{options[0]} is '{value:.60}'{likely_number(value)}"
    else:
        return text
    return f"{options[0]} is '{value:.60}'; allowed: {allowed}"


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
    from filter_service.progress import Progress

    with Progress(quiet=quiet) as progress:
        task = progress.task(title, total=1.0, unit="%")
        yield task.update


def check_range(option: str, value: float, limits: tuple[float, float]) -> None:
    """Check that a number is within ``limits`` and not NaN.

    Raises
    ------
    ValueError
        If it is not.  The message names the option, the value, the range and, if the
        value fits in another unit, that unit.
    """
    low, high = limits
    if not low <= value <= high:
        hint = likely_unit(option, value, limits)
        raise ValueError(f"{option} is {value:g}; allowed: {low:g} to {high:g}{hint}")


def likely_unit(name: str, value: float, limits: tuple[float, float]) -> str:
    """Return the unit in which a value fits an option, as the end of an error."""
    unit = re.split("[-_]", name)[-1]
    low, high = limits
    for other, factor in OTHER_UNITS.get(unit, ()):
        if low <= factor * value <= high:
            return f" {unit} ({value:g} {other} is {factor * value:.4g} {unit})"
    return f" {unit}" if unit in UNITS else ""


def likely_number(text: str) -> str:
    """Return the number that text probably means, as the end of an error."""
    if text.count(",") == 1:
        with_point = text.replace(",", ".")
        if _is_number(with_point):
            return f"; allowed: a decimal point, as in {with_point.strip()}"
    if match := _NUMBER_AND_UNIT.fullmatch(text):
        return f"; allowed: a number without '{match[2]}', as in {match[1]}"
    return "; allowed: a number"


def given_value(options: Sequence[str], arguments: Sequence[str]) -> str | None:
    """Return the last text that a command line gives for an option with these names."""
    found = None
    for k, argument in enumerate(arguments):
        name, is_joined, value = argument.partition("=")
        if name in options:
            found = value if is_joined else next(iter(arguments[k + 1 :]), None)
    return found


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
