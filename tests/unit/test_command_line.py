"""The table of commands, and errors that name the value and the likely mistake."""

import importlib
import subprocess
import sys
from types import SimpleNamespace
from typing import get_args

import pytest

from clients.batch.layouts import LAYOUTS
from clients.batch.options import Layout
from clients.commands.options import OPTION_HELP
from clients.commands.program import COMMANDS, app
from clients.natural_eye import NaturalEye
from filter_service import command_line, serve
from filter_service.command_line import (
    check_range,
    exit_code,
    given_value,
    likely_unit,
)
from filter_service.settings import DEFAULTS, setting_types
from tests.commands import run_command
from tests.source_tree import ROOT

HOMES = {target.partition(":")[0] for target, _ in COMMANDS.values()}
for home in HOMES:  # before the tests: reports load Matplotlib
    importlib.import_module(home)


def refused(capsys, *arguments):
    """Run the command line; return its one line on stderr."""
    assert exit_code(app, list(arguments), "ocufilter") == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


FILTER = ("filter", "--color", "a.png", "--fov-deg", "50", "--profile", "myopia")
FILTER += ("-o", "b.png", "--distance-m", "2")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--focus-dpt 2,5", "is '2,5'; allowed: a decimal point, as in 2.5"),
        ("--distance-m 2m", "is '2m'; allowed: a number without 'm', as in 2"),
        ("--pupil-mm wide", "is 'wide'; allowed: a number"),
        ("--pupil-mm 0.004", "is 0.004; allowed: 0.5 to 9 mm (0.004 m is 4 mm)"),
        ("--distance-m 0.01", "is 0.01; allowed: 0.05 to inf m"),
        ("--gaze-h-deg 5deg", "is '5deg'; allowed: a number without 'deg', as in 5"),
        ("--render-tolerance 9", "is 9; allowed: 0 to 8"),
    ],
)
def test_a_command_names_the_value_and_the_likely_mistake(capsys, given, said):
    option, value = given.split()
    for arguments in ((option, value), (f"{option}={value}",)):
        line = refused(capsys, *FILTER, *arguments)
        assert line == f"ocufilter: {option} {said}"


@pytest.mark.parametrize(
    "command",
    [("wavefront",), ("field",), ("psf", "--pixel-arcmin", "1", "-o", "a.npy")],
)
def test_a_wavelength_in_micrometers_is_recognized(capsys, command):
    given = ("navarro", "--pupil-mm", "4", "--wavelength-nm", "0.555")
    line = refused(capsys, *command, *given)
    assert line.endswith(" nm (0.555 um is 555 nm)")


@pytest.mark.parametrize("text", ["1,000,000", "2 5", "0x10", "4" * 99 + "q"])
def test_what_is_no_number_is_named(capsys, text):
    line = refused(capsys, *FILTER, f"--fov-deg={text}")
    assert line.startswith(f"ocufilter: --fov-deg is '{text[:60]}'; allowed: a number")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("demo --frames 2.5", "--frames is '2.5'; allowed: an integer"),
        ("demo --frames 0", "--frames is '0'; allowed: 1 or more"),
        ("latency --frames=200000", "--frames is '200000'; allowed: 100000 or less"),
        ("serve --engine cuda", "--engine is 'cuda'; allowed: auto, gl, native"),
        ("psf navarro --method=dct", "--method is 'dct'; allowed: auto, fourier, "),
        ("fliter", "No such command 'fliter'. Did you mean 'filter'?"),
        ("psf", "Missing argument 'EYE'."),
    ],
)
def test_a_refusal_names_the_value_and_what_is_allowed(capsys, given, said):
    assert refused(capsys, *given.split()).startswith(f"ocufilter: {said}")


@pytest.fixture(scope="module")
def help_text():
    return run_command("--help").stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_and_a_summary_that_is_not_cut(help_text, name):
    assert f"  {name:<13}  {COMMANDS[name][1]}\n" in help_text
    shown = run_command(name, "--help")
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.startswith(f"Usage: ocufilter {name} ")


def modules_loaded(script, *words):
    """Run a script; return the modules that it has loaded at its end."""
    finished = subprocess.run(
        [
            sys.executable,
            "-c",
            f"{script}\nprint(*sys.modules, file=sys.stderr)",
            *words,
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert finished.returncode == 0, finished.stderr
    return set(finished.stderr.split()), finished.stdout


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_the_program_loads_no_command_that_does_not_run(option):
    script = (
        "import sys\n"
        "from filter_service.command_line import exit_code\n"
        "from clients.commands.program import app\n"
        "assert exit_code(app, sys.argv[1:], 'ocufilter') == 0"
    )
    loaded, _ = modules_loaded(script, option)
    assert "clients.commands.program" in loaded
    assert not loaded & {*HOMES, "numpy"}


@pytest.mark.parametrize("words", ["serve --help", "--help"])
def test_the_service_starts_without_the_clients(words):
    script = (
        "import sys, runpy\n"
        "try:\n    runpy.run_module('filter_service', run_name='__main__')\n"
        "except SystemExit as ended:\n    assert ended.code == 0"
    )
    loaded, shown = modules_loaded(script, *words.split())
    assert "--bind ENDPOINT" in shown
    assert "filter_service.serve" in loaded
    assert not [name for name in loaded if name.split(".")[0] == "clients"]


def test_the_service_names_where_other_commands_are(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["filter_service", "demo", "--frames", "2"])
    with pytest.raises(SystemExit) as ended:
        serve.main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "unknown command 'demo'; allowed: serve; for other commands, use" in line


def test_a_pupil_in_meters_is_recognized(capsys):
    line = refused(
        capsys, *["batch", "room", "-p", "myopia", "-o", "out", "--pupil-mm", "0.004"]
    )
    assert line.endswith("--pupil-mm is 0.004; allowed: 0.5 to 9 mm (0.004 m is 4 mm)")
    with pytest.raises(ValueError, match=r"0\.004; allowed: .* \(0\.004 m is 4 mm\)"):
        NaturalEye(pupil_diameter_mm=0.004)


def test_an_option_that_turns_a_setting_off_has_its_own_help():
    shown = " ".join(run_command("filter", "--help").stdout.split())
    switches = [name for name in setting_types() if getattr(DEFAULTS, name) is True]
    assert switches
    for name in switches:
        assert f"--no-{name} {OPTION_HELP[name]}" in shown
    assert "--gaze-h-deg <float> Gaze to the right of the image's axis, deg." in shown
    assert "--gaze-v-deg <float> Gaze above the image's axis, deg." in shown


@pytest.mark.parametrize("focus", ["2.5dpt", "1,2.5dpt"])
def test_a_focus_of_a_batch_is_a_number_or_the_center(tmp_path, capsys, focus):
    from PIL import Image

    for name in ("a_color.png", "a_depth.png"):
        Image.new("I;16" if "depth" in name else "RGB", (4, 4)).save(tmp_path / name)
    given = [str(tmp_path), "-p", "myopia", "-o", str(tmp_path / "out")]
    line = refused(capsys, "batch", *given, "--fov-deg", "40", "--focus-dpt", focus)
    assert line.startswith(f"ocufilter: --focus-dpt is '{focus}'; ")
    assert line.endswith("2.5, or center")


def test_the_layouts_of_a_batch_are_those_that_it_reads():
    assert get_args(Layout) == LAYOUTS


def test_a_number_outside_its_range_is_named():
    check_range("--pupil-mm", 0.5, (0.5, 9.0))
    with pytest.raises(ValueError, match="--pupil-mm is nan"):
        check_range("--pupil-mm", float("nan"), (0.5, 9.0))
    assert likely_unit("--count", 5.0, (1.0, 2.0)) == ""
    assert likely_unit("--focus-dpt", 25.0, (0.0, 20.0)) == " dpt"


def test_the_last_value_of_an_option_counts():
    given = ["--pupil-mm", "1", "-x", "--pupil-mm=2", "--pupil"]
    assert given_value(["--pupil-mm"], given) == "2"
    assert given_value(["--pupil"], given) is None
    assert given_value(["--focus"], given) is None
    error = SimpleNamespace(format_message=lambda: "Missing option.")
    assert command_line._with_value(error, given) == "Missing option."
