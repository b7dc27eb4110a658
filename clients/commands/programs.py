"""`ocufilter demo`, `headset`, `layer`, `report`, `batch`, `web` and `doctor`.

Modules that do the work are imported only when a command runs.
"""

import importlib
from pathlib import Path
from typing import Annotated, Any

import typer

from clients.commands.console import CommandFailed, Json, print_json, print_line


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder.")] = Path(
        "out/demo"
    ),
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames per eye.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Frame size in px, such as 480x270."),
    ] = None,
    json_output: Json = False,
) -> None:
    """Stream two scenes through six eyes and write a video and a contact sheet.

    Starts a service of its own and a client that connects to it.  Writes a video (a GIF
    without the package av), contact_sheet.png and latency.json.

    ocufilter demo --out out/demo --frames 24 --size 480x270
    """
    arguments = ["--out", str(out)]
    if frames is not None:
        arguments += ["--frames", str(frames)]
    if size is not None:
        from clients.arguments import read_size_px  # imports the profile reader: 60 ms

        width_px, height_px = read_size_px(size)
        arguments += ["--size", f"{width_px}x{height_px}"]
    _run("clients.demo", [*arguments, *["--json"] * json_output])


def headset(context: typer.Context) -> None:
    """Show a scene in an OpenXR headset, each eye through its own profile.

    For its options, see `ocufilter headset --help`.

    ocufilter headset --left myopia --right keratoconus
    """
    _run("clients.headset.program", context.args)


def layer(context: typer.Context) -> None:
    """Run another OpenXR program, unmodified, seen through simulated eyes.

    For its actions and options, see `ocufilter layer --help`.

    ocufilter layer run --left myopia -- hello_xr -g OpenGL
    """
    _run("clients.openxr_layer.program", context.args)


def report(context: typer.Context) -> None:
    """Write a report on one eye, or a before-and-after comparison, as HTML or PDF.

    For its options, see `ocufilter report --help`.

    ocufilter report keratoconus -o eye.html
    """
    _run("clients.report.program", context.args)


def batch(context: typer.Context) -> None:
    """Filter data sets, folders and videos of color and depth, on all cores.

    For its options and the supported layouts, see `ocufilter batch --help`.

    ocufilter batch rgbd_dataset_freiburg1_desk -p myopia -p keratoconus -o seen
    """
    _run("clients.batch.program", context.args)


def web(context: typer.Context) -> None:
    """Serve a web page with an eye's data, sliders, and before-and-after views.

    For its options, see `ocufilter web --help`.

    ocufilter web --profile myopia
    """
    _run("clients.web.program", context.args)


def _run(module: str, arguments: list[str]) -> None:
    """Import a client program and run it."""
    code = importlib.import_module(module).main(arguments)
    if code:
        raise typer.Exit(code)


def doctor(json_output: Json = False) -> None:
    """Check whether this machine has everything that ocufilter requires.

    Prints how to install what is missing.  The exit code is 0 if the service can run
    here and 1 if it cannot.

    ocufilter doctor --json
    """
    from clients.commands.doctor_checks import examine

    report = examine()
    if json_output:
        print_json(report)
    else:
        _print_diagnosis(report)
    if not report["ok"]:
        fails = ", ".join(name for name, ok in report["works"].items() if not ok)
        raise CommandFailed(f"the service cannot run here; failed: {fails}")


def _print_diagnosis(report: dict[str, Any]) -> None:
    machine = report["machine"]
    print_line(
        f"ocufilter {report['version']}, {machine['system']}, "
        f"{machine['processor']}, {machine['n_cores']} cores"
    )
    for check in report["checks"]:
        print_line(
            f"  {'ok ' if check['ok'] else 'NO '} {check['name']}: {check['detail']}"
        )
    for name, value in report["gl"]["limits"].items():
        print_line(f"      {name}: {value}")
    for device in report["gl"]["devices"]:
        found = device["renderer"] or f"no context: {device['error']}"
        print_line(f"      EGL device {device['index']} ({device['name']}): {found}")
    works = [name for name, ok in report["works"].items() if ok]
    fails = [name for name, ok in report["works"].items() if not ok]
    print_line("works here: " + (", ".join(works) or "nothing"))
    if fails:
        print_line("does not work here: " + ", ".join(fails))
    for command in report["install"]:
        print_line(f"install: {command}")
