"""The `ocufilter` program: its commands, each of which is imported when it runs."""

import sys
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from filter_service import one_blas_thread  # noqa: F401  (before any numpy)
from filter_service.command_line import app_of, print_line, run, typer_app

COMMANDS = {
    # name: where its function or typer application is, and what `--help` says
    "demo": (
        "clients.demo:demo",
        "Stream two scenes through six eyes; write a video.",
    ),
    "serve": (
        "filter_service.serve:serve",
        "Filter frames for clients until interrupted.",
    ),
    "status": (
        "clients.commands.service:status",
        "Print the state of a running service.",
    ),
    "latency": (
        "clients.commands.service:latency",
        "Time frames through a running service; compute their error.",
    ),
    "keys": (
        "clients.commands.service:keys",
        "Create and revoke client keys of a service.",
    ),
    "eyes": (
        "clients.commands.service:eyes",
        "List and erase the eyes that a service cached on disk.",
    ),
    "filter": (
        "clients.commands.filter_image:filter_image",
        "Filter one image with depth through one eye.",
    ),
    "bands": (
        "clients.commands.filter_bands:filter_bands",
        "Filter an image in many wavelengths, or as cones see it.",
    ),
    "correct": (
        "clients.commands.correct_image:correct_image",
        "Solve for the picture that a viewer sees as it was meant.",
    ),
    "best-lens": (
        "clients.commands.best_lens:find_best_lens",
        "Find the spectacles or contact lens best for a scene.",
    ),
    "batch": (
        "clients.batch.program:batch",
        "Filter folders and videos of color and depth, on all cores.",
    ),
    "bank": (
        "clients.commands.eye_bank:bank",
        "Build the eyes of many persons once, for training data.",
    ),
    "stimuli": (
        "clients.stimuli.program:stimuli",
        "Draw stimuli of exact size; filter them through eyes.",
    ),
    "scenario": (
        "clients.commands.scenario:scenario",
        "Show what a person sees before and after, or with two lenses.",
    ),
    "estimate": (
        "clients.commands.eye:estimate",
        "Estimate the eye that reproduces a measured wavefront.",
    ),
    "wavefront": (
        "clients.commands.wavefront:wavefront",
        "Print the Zernike coefficients of an eye in one direction.",
    ),
    "field": (
        "clients.commands.eye:field",
        "Print refraction and aberrations over the visual field.",
    ),
    "psf": (
        "clients.commands.psf:psf",
        "Compute PSFs as arrays or images.",
    ),
    "mtf": (
        "clients.commands.image_quality:mtf",
        "Print the modulation transfer function.",
    ),
    "acuity": (
        "clients.commands.image_quality:acuity",
        "Print visual acuity and the visual Strehl ratio.",
    ),
    "refraction": (
        "clients.commands.image_quality:refraction",
        "Print the lens that corrects an eye for infinity.",
    ),
    "through-focus": (
        "clients.commands.image_quality:through_focus",
        "Print acuity and modulation by defocus.",
    ),
    "report": (
        "clients.report.program:report",
        "Write a report on one eye, or a comparison of two.",
    ),
    "headset": (
        "clients.headset.program:headset",
        "Show a scene in an OpenXR headset, through two eyes.",
    ),
    "layer": (
        "clients.openxr_layer.program:layer",
        "See another OpenXR program through simulated eyes.",
    ),
    "web": (
        "clients.web.program:web",
        "Serve a web page with an eye's data and filtered views.",
    ),
    "bench": (
        "clients.commands.checkout:bench",
        "Time one part of the program, with its error.",
    ),
    "paper": (
        "clients.commands.checkout:paper",
        "Compare the paper's tables and figures with ours.",
    ),
    "doctor": (
        "clients.commands.doctor:doctor",
        "Check what works on this machine, and what is missing.",
    ),
}


class _Commands(TyperGroup):
    """The commands of the table, without the modules of those that do not run."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: dict[str, Any] = dict.fromkeys(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        found = getattr(import_module(module), attribute)
        app = found if isinstance(found, typer.Typer) else app_of(found)
        command = get_command(app)
        command.name = cmd_name
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


app = typer_app(
    name="ocufilter",
    cls=_Commands,
    help="See through another person's eyes.  Start with `ocufilter demo`; "
    "`ocufilter doctor` reports what is missing on this machine.",
    epilog="Option names end in their unit: mm, nm, deg, dpt (diopters; 0 is "
    "infinity).  "
    "Exit codes: 0 success, 1 failure, 2 invalid input.",
)


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
    traceback: bool = typer.Option(  # noqa: ARG001  (`exit_code` reads it)
        False, help="Show the traceback of an error."
    ),
) -> None:
    if context.invoked_subcommand is None:
        sys.stdout.write(context.get_help() + "\n")


def main() -> None:
    """Run the program; errors become one line on stderr and an exit code."""
    run(app, "ocufilter")


if __name__ == "__main__":
    main()
