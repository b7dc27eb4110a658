"""`ocufilter demo`, `bench` and others: start programs of the clients and tests.

They run as separate processes: the service never imports its clients or tests.
"""

import importlib.util
import json
import os
import subprocess
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from filter_service.commands.console import CommandFailed, Json, say

CHECKOUT = Path(__file__).resolve().parents[2]


class Bench(StrEnum):
    """Benchmarks, named after what they time."""

    ESTIMATE = "estimate"
    FOCUS = "focus"
    PEOPLE = "people"
    MEDIA = "media"
    ACUITY = "acuity"
    CORRECTIONS = "corrections"
    DYNAMICS = "dynamics"
    DISPLAYS = "displays"
    NETWORKS = "networks"
    PLAN = "plan"
    PSF = "psf"
    LAYERS = "layers"
    RENDER = "render"
    LIVE = "live"
    FOLLOW = "follow"
    LEVELS = "levels"
    CROPS = "crops"
    KERNELS = "kernels"
    FIELD = "field"
    OCCLUSION = "occlusion"
    SEQUENCE = "sequence"
    COST = "cost"
    PEERS = "peers"
    SWITCH = "switch"
    HEADSET = "headset"
    HOST = "host"
    ABUSE = "abuse"
    FILES = "files"
    OVERLOAD = "overload"
    DEVICES = "devices"
    RESTART = "restart"
    BATCH = "batch"
    ROUNDTRIP = "roundtrip"
    WEB = "web"


BENCH_MODULES = {
    Bench.ESTIMATE: "tests.benchmarks.bench_estimate",
    Bench.FOCUS: "tests.benchmarks.bench_focus",
    Bench.PEOPLE: "tests.benchmarks.bench_people",
    Bench.MEDIA: "tests.benchmarks.bench_media",
    Bench.ACUITY: "tests.benchmarks.bench_acuity",
    Bench.CORRECTIONS: "tests.benchmarks.bench_corrections",
    Bench.DYNAMICS: "tests.benchmarks.bench_dynamics",
    Bench.DISPLAYS: "tests.benchmarks.bench_displays",
    Bench.NETWORKS: "tests.benchmarks.bench_networks",
    Bench.PLAN: "tests.benchmarks.bench_plan",
    Bench.PSF: "tests.benchmarks.bench_psf",
    Bench.LAYERS: "tests.benchmarks.bench_layers",
    Bench.RENDER: "tests.benchmarks.bench_render",
    Bench.LIVE: "tests.benchmarks.bench_live",
    Bench.FOLLOW: "tests.benchmarks.bench_follow",
    Bench.LEVELS: "tests.benchmarks.bench_levels",
    Bench.CROPS: "tests.benchmarks.bench_crops",
    Bench.KERNELS: "tests.benchmarks.bench_kernels",
    Bench.FIELD: "tests.benchmarks.bench_field",
    Bench.OCCLUSION: "tests.benchmarks.bench_occlusion",
    Bench.SEQUENCE: "tests.benchmarks.bench_sequence",
    Bench.COST: "tests.benchmarks.bench_cost",
    Bench.PEERS: "tests.benchmarks.bench_peers",
    Bench.SWITCH: "tests.benchmarks.bench_switch",
    Bench.HEADSET: "tests.benchmarks.bench_headset",
    Bench.HOST: "tests.benchmarks.bench_host",
    Bench.ABUSE: "tests.benchmarks.bench_abuse",
    Bench.FILES: "tests.benchmarks.bench_files",
    Bench.OVERLOAD: "tests.benchmarks.bench_overload",
    Bench.DEVICES: "tests.benchmarks.bench_devices",
    Bench.RESTART: "tests.benchmarks.bench_restart",
    Bench.BATCH: "tests.benchmarks.bench_batch",
    Bench.ROUNDTRIP: "clients.latency",
    Bench.WEB: "tests.benchmarks.bench_web",
}


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for what it writes.")
    ] = Path("out/demo"),
    frames: Annotated[
        int | None, typer.Option(min=1, help="Frames of each eye.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Frame size in px, as 480x270.")
    ] = None,
    json_output: Json = False,
) -> None:
    """Stream two scenes through six eyes and write a video and a contact sheet.

    Starts its own service and a pyrender client that connects to it.  Writes a video,
    contact_sheet.png and latency.json.

    ocufilter demo --out out/demo --frames 24 --size 480x270
    """
    arguments = ["--out", str(out.absolute())]
    if frames is not None:
        arguments += ["--frames", str(frames)]
    if size is not None:
        arguments += ["--size", _checked_size(size)]
    _run_program("clients.demo", arguments, json_output=json_output)


def headset(context: typer.Context) -> None:
    """Show a scene in an OpenXR headset, each eye through its own profile.

    Its options: `ocufilter headset --help`.

    ocufilter headset --left myopia --right keratoconus
    """
    _become("clients.headset.program", context.args)


def report(context: typer.Context) -> None:
    """Write a report of one eye, or a before-and-after comparison, as HTML or PDF.

    Its options: `ocufilter report --help`.

    ocufilter report keratoconus -o eye.html
    """
    _become("clients.report.program", context.args)


def batch(context: typer.Context) -> None:
    """Filter data sets, folders and videos of color and depth, on all cores.

    Its options and the layouts it reads: `ocufilter batch --help`.

    ocufilter batch rgbd_dataset_freiburg1_desk -p myopia -p keratoconus -o seen
    """
    _become("clients.batch.program", context.args)


def web(context: typer.Context) -> None:
    """Serve a web page with an eye's data, sliders, and before and after views.

    Its options: `ocufilter web --help`.

    ocufilter web --profile myopia
    """
    _become("clients.web.program", context.args)


def _become(program: str, arguments: list[str]) -> None:
    """Replace this process by a program, or print its help."""
    folder = _folder_to_start_in(program)
    if {"-h", "--help"} & set(arguments):
        command = [sys.executable, "-m", program, "--help"]
        say(subprocess.check_output(command, cwd=folder, text=True).rstrip())
        return
    if folder is not None:
        os.chdir(folder)
    sys.stdout.flush()
    # The program replaces this process, so it receives signals itself.
    os.execv(sys.executable, [sys.executable, "-m", program, *arguments])


def bench(
    context: typer.Context,
    name: Annotated[Bench, typer.Argument(help="What to time.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer cases and repeats.")
    ] = False,
    json_output: Json = False,
) -> None:
    """Time one part of the program and report its error alongside.

    ocufilter bench psf --quick

    Other options are passed to the benchmark:

    ocufilter bench roundtrip --transport shm --stereo
    """
    arguments = [*(["--quick"] if quick else []), *context.args]
    _run_program(BENCH_MODULES[name], arguments, json_output=json_output)


def paper(
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="The page, one file.")
    ] = Path("paper.html"),
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Run the benchmarks first; it says how long."),
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="With --fresh: few cases, small frames.")
    ] = False,
    json_output: Json = False,
) -> None:
    """Compare the paper's tables and figures with ours in one HTML page.

    Uses the committed results and takes seconds.  Shows published figures, ours, the
    differences, and where the paper is better.  Requires a checkout.

    ocufilter paper -o paper.html
    """
    if quick and not fresh:
        raise ValueError("--quick: allowed with --fresh only")
    arguments = ["--out", str(out.absolute())]
    arguments += ["--fresh"] * fresh + ["--quick"] * quick
    program = "tests.benchmarks.paper_page.program"
    _run_program(program, arguments, json_output=json_output)


def _checked_size(size: str) -> str:
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() and int(p) >= 16 for p in parts):
        raise ValueError(f"--size '{size}': allowed is WIDTHxHEIGHT, 16 px or more")
    return "x".join(parts)


def _run_program(module: str, arguments: list[str], *, json_output: bool) -> None:
    folder = _folder_to_start_in(module)
    command = [sys.executable, "-m", module, *arguments]
    if not json_output:
        finished = subprocess.run(command, cwd=folder, check=False)
    else:
        finished = subprocess.run(
            [*command, "--json"], cwd=folder, stdout=subprocess.PIPE, check=False
        )
    if finished.returncode in (1, 2):  # it reported why on our stderr
        raise typer.Exit(finished.returncode)
    if finished.returncode != 0:
        raise CommandFailed(f"{module} ended with code {finished.returncode}")
    if json_output:
        say(json.dumps(_one_json_object(finished.stdout, module)))


def _one_json_object(output: bytes, module: str) -> dict:
    try:
        return json.loads(output)
    except ValueError as error:
        raise CommandFailed(f"{module} printed no JSON object: {error}") from None


def _folder_to_start_in(module: str) -> Path | None:
    """Return the folder where ``python -m`` finds a program; None if any will do.

    The `ocufilter` of an editable install sees the installed packages only, which do
    not include the tests: those are found from the checkout's folder.

    Raises
    ------
    CommandFailed
        If the program is not installed and needs a checkout.
    """
    try:
        if importlib.util.find_spec(module) is not None:
            return None
    except ModuleNotFoundError:
        pass
    if CHECKOUT.joinpath(*module.split(".")).with_suffix(".py").is_file():
        return CHECKOUT
    package = module.partition(".")[0]
    raise CommandFailed(
        f"this command runs a program in {package}/, which an installed package "
        "does not hold: run it in a checkout (git clone of the project, then make "
        "setup-test)"
    )
