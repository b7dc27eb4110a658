"""The `ocufilter` program: dispatch of commands, and one line for each error."""

import io
import sys

import typer
from typer.exceptions import Abort, TyperException

from clients.commands.checkout import bench, paper
from clients.commands.console import CommandFailed, print_line
from clients.commands.estimate import estimate
from clients.commands.eyes import eyes
from clients.commands.field import field
from clients.commands.filter_image import filter_image
from clients.commands.keys import keys
from clients.commands.latency import latency
from clients.commands.programs import (
    batch,
    demo,
    doctor,
    headset,
    layer,
    report,
    web,
)
from clients.commands.psf import psf
from clients.commands.serve import serve
from clients.commands.status import status
from clients.commands.wavefront import wavefront
from clients.option_values import given_value, likely_number
from filter_service import one_blas_thread  # noqa: F401  (before any numpy)

EXIT_FAILURE = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130

app = typer.Typer(
    name="ocufilter",
    help="See through another person's eyes.  Start with `ocufilter demo`; "
    "`ocufilter doctor` reports what is missing on this machine.",
    epilog="Option names end in their unit: mm, nm, deg, dpt (diopters; 0 is "
    "infinity).  "
    "Exit codes: 0 success, 1 failure, 2 invalid input.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(demo)
app.command()(serve)
app.command()(status)
app.command()(latency)
app.add_typer(keys, name="keys")
app.add_typer(eyes, name="eyes")
app.command(name="filter")(filter_image)
app.command()(estimate)
app.command()(wavefront)
app.command()(field)
app.command()(psf)
app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)(bench)
for program in (headset, layer, web, batch, report):
    app.command(
        context_settings={
            "allow_extra_args": True,
            "ignore_unknown_options": True,
            "help_option_names": [],  # the program prints its own help
        }
    )(program)
app.command()(paper)
app.command()(doctor)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        from filter_service.version import __version__

        print_line(f"ocufilter {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: bool = typer.Option(  # noqa: ARG001  (its callback prints it)
        False,
        "--version",
        callback=_print_version,
        is_eager=True,
        help="Print the version and exit.",
    ),
    traceback: bool = typer.Option(  # noqa: ARG001  (`_exit_code` reads it)
        False, help="Show the traceback of an error."
    ),
) -> None:
    if context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")


def main() -> None:
    """Run the program; errors become one line on stderr and an exit code."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        # otherwise a file whose name is not UTF-8 ends a finished command with an error
        sys.stdout.reconfigure(errors="backslashreplace")
    sys.exit(_exit_code(sys.argv[1:]))


def _exit_code(arguments: list[str]) -> int:
    try:
        return app(arguments, prog_name="ocufilter", standalone_mode=False) or 0
    except (Abort, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    except Exception as error:
        if "--traceback" in arguments[:1]:
            raise
        code, text = _code_and_text(error, arguments)
        sys.stderr.write(f"ocufilter: {' '.join(text.split())}\n")
        return code


def _code_and_text(error: Exception, arguments: list[str]) -> tuple[int, str]:
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
    kind = type(error).__name__
    return EXIT_FAILURE, f"{kind}: {error} (see ocufilter --traceback ...)"


def _with_value(error: TyperException, arguments: list[str]) -> str:
    """Return the message of an error; Typer's does not name a wrong number."""
    text = error.format_message()
    options: list[str] = getattr(getattr(error, "param", None), "opts", [])
    value = given_value(options, arguments)
    if value is None or not ("valid number" in text or "valid integer" in text):
        return text
    is_whole = "valid integer" in text
    allowed = "; allowed: an integer" if is_whole else likely_number(value)
    return f"{options[0]} is '{value:.60}'{allowed}"


if __name__ == "__main__":
    main()
