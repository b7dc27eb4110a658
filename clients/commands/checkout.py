"""`ocufilter bench` and `paper`, which run programs of a checkout's tests."""

import runpy
import sys
from pathlib import Path
from typing import Annotated

import typer

from filter_service.command_line import CommandFailed, Json, typer_app

CHECKOUT = Path(__file__).resolve().parents[2]
BENCHMARKS = CHECKOUT / "tests" / "benchmarks"


bench = typer_app()


@bench.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True}
)
def run_benchmark(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(
            help="Benchmark to run, such as acuity or live; any unknown name lists all."
        ),
    ],
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer cases and repeats.")
    ] = False,
    json_output: Json = False,
) -> None:
    """Time one part of the program and report its error alongside.

    ocufilter bench acuity --quick

    Requires a checkout; `ocufilter latency` measures a running service without one.
    Other options are passed to the benchmark:

    ocufilter bench faults --only upgrade
    """
    names = sorted(
        path.stem.removeprefix("bench_") for path in _benchmarks().glob("bench_*.py")
    )
    if name not in names:
        raise ValueError(f"bench: unknown name '{name}'; allowed: {', '.join(names)}")
    _run_module(
        "tests.benchmarks",
        [name, *["--quick"] * quick, *["--json"] * json_output, *context.args],
    )


def paper(
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="Output page.")
    ] = Path("paper.html"),
    fresh: Annotated[
        bool,
        typer.Option(
            "--fresh", help="Run the benchmarks first; prints the estimated time."
        ),
    ] = False,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="With --fresh: run few cases with small frames."),
    ] = False,
    json_output: Json = False,
) -> None:
    """Compare the paper's tables and figures with ours in one HTML page.

    Uses the committed results and takes seconds.  Shows the published figures, ours,
    the differences, and where the paper is better.  Requires a checkout.

    ocufilter paper -o paper.html
    """
    if quick and not fresh:
        raise ValueError("--quick: allowed with --fresh only")
    _benchmarks()
    arguments = ["--out", str(out.absolute())]
    arguments += ["--fresh"] * fresh + ["--quick"] * quick + ["--json"] * json_output
    _run_module("tests.benchmarks.paper_page.program", arguments)


def _benchmarks() -> Path:
    """Return the benchmarks folder.

    Raises
    ------
    CommandFailed
        If this is an installed package, which lacks that folder.
    """
    if not BENCHMARKS.is_dir():
        raise CommandFailed(
            "this command runs a program in tests/, which is not installed with the "
            "package: run it in a checkout (git clone, then make setup-test)"
        )
    return BENCHMARKS


def _run_module(module: str, arguments: list[str]) -> None:
    """Run a module as ``python -m`` does."""
    # An editable install does not put tests/ on the path.
    sys.path.insert(0, str(CHECKOUT))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
