"""Numbers on the command line: errors name the value and the likely mistake."""

import argparse
from types import SimpleNamespace

import pytest

from clients.batch.options import arguments_of, batch_of
from clients.commands import program
from clients.natural_eye import NaturalEye
from clients.option_values import a_number, check_range, given_value, likely_unit


def refused(capsys, *arguments):
    """Run the command line; return its one line on stderr."""
    assert program._exit_code(list(arguments)) == 2
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


def test_a_number_that_is_not_whole_is_named(capsys):
    line = refused(capsys, "demo", "--frames", "2.5")
    assert line == "ocufilter: --frames is '2.5'; allowed: an integer"


def test_a_program_of_its_own_says_the_same(capsys):
    given = ["room", "-p", "myopia", "-o", "out"]
    with pytest.raises(SystemExit):
        arguments_of([*given, "--pupil-mm", "4,5"])
    last = capsys.readouterr().err.splitlines()[-1]
    assert "--pupil-mm: '4,5' is not a number; allowed: a decimal point" in last
    with pytest.raises(ValueError, match=r"allowed: 0\.5 to 9 mm \(0\.004 m is 4 mm\)"):
        batch_of(arguments_of([*given, "--pupil-mm", "0.004"]))
    with pytest.raises(ValueError, match=r"0\.004; allowed: .* \(0\.004 m is 4 mm\)"):
        NaturalEye(pupil_diameter_mm=0.004)


@pytest.mark.parametrize("focus", ["2,5", "2.5dpt"])
def test_a_focus_of_a_batch_is_a_number_or_the_center(tmp_path, focus):
    from PIL import Image

    for name in ("a_color.png", "a_depth.png"):
        Image.new("I;16" if "depth" in name else "RGB", (4, 4)).save(tmp_path / name)
    given = [str(tmp_path), "-p", "myopia", "-o", str(tmp_path / "out")]
    options = arguments_of([*given, "--fov-deg", "40", "--focus-dpt", focus])
    with pytest.raises(
        ValueError, match=rf"--focus-dpt is '{focus}'; .*2\.5, or center"
    ):
        batch_of(options)


def test_numbers_are_numbers():
    assert a_number(" 2.5e1 ") == 25.0
    assert a_number("inf") == float("inf")
    for text in ("1,000,000", "", "2 5", "0x10", "4" * 99 + "q"):
        with pytest.raises(
            argparse.ArgumentTypeError, match="is not a number; allowed"
        ):
            a_number(text)
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
    assert program._with_value(error, given) == "Missing option."
