"""`ocufilter demo`, `headset`, `report`, `batch` and `web`."""

import importlib
from pathlib import Path
from typing import Annotated

import typer

from clients.commands.console import CommandFailed, Json
from clients.extra import what_to_install


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder.")] = Path(
        "out/demo"
    ),
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
    arguments = ["--out", str(out)]
    if frames is not None:
        arguments += ["--frames", str(frames)]
    if size is not None:
        from clients.arguments import read_size_px  # reads profiles, too: 60 ms

        width_px, height_px = read_size_px(size)
        arguments += ["--size", f"{width_px}x{height_px}"]
    try:
        _run("clients.demo", [*arguments, *["--json"] * json_output])
    except ModuleNotFoundError as error:
        raise CommandFailed(what_to_install(error)) from None


def headset(context: typer.Context) -> None:
    """Show a scene in an OpenXR headset, each eye through its own profile.

    Its options: `ocufilter headset --help`.

    ocufilter headset --left myopia --right keratoconus
    """
    _run("clients.headset.program", context.args)


def report(context: typer.Context) -> None:
    """Write a report of one eye, or a before-and-after comparison, as HTML or PDF.

    Its options: `ocufilter report --help`.

    ocufilter report keratoconus -o eye.html
    """
    _run("clients.report.program", context.args)


def batch(context: typer.Context) -> None:
    """Filter data sets, folders and videos of color and depth, on all cores.

    Its options and the layouts it reads: `ocufilter batch --help`.

    ocufilter batch rgbd_dataset_freiburg1_desk -p myopia -p keratoconus -o seen
    """
    _run("clients.batch.program", context.args)


def web(context: typer.Context) -> None:
    """Serve a web page with an eye's data, sliders, and before and after views.

    Its options: `ocufilter web --help`.

    ocufilter web --profile myopia
    """
    _run("clients.web.program", context.args)


def _run(module: str, arguments: list[str]) -> None:
    """Run a program of the clients, which is loaded only when it is used."""
    code = importlib.import_module(module).main(arguments)
    if code:
        raise typer.Exit(code)
