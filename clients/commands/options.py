"""Options that commands share: records of options, settings, profiles, sizes.

A setting that is a choice becomes an option such as ``--mode``, and angles become
``--gaze-h-deg`` and ``--gaze-v-deg``.  A switch becomes ``--no-chromatic`` if it is on
by default, and ``--lateral-color`` if it is off.  Ranges and planes have no option:
commands derive them from the image.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Annotated, Any, NoReturn, cast, get_args, get_type_hints

import numpy as np
import typer

from estimator.bounded_files import InvalidFile, loads_bounded, printable, read_text
from filter_service.displays import DisplaySpectra, primaries_of_spectra
from filter_service.errors import BadMessage
from filter_service.settings import DEFAULTS, setting_help, setting_types
from filter_service.validation import checked

MAX_ARGUMENT_BYTES = 1_000_000
MAX_TITLE_CHARACTERS = 100

SIDES = ("h", "v")
OPTION_HELP = {
    # options that say something else than their setting
    "gaze_h_deg": "Gaze to the right of the image's axis, deg.",
    "gaze_v_deg": "Gaze above the image's axis, deg.",
    "gaze_range_h_deg": "Largest turn of a frame's gaze to the left or right, deg.",
    "gaze_range_v_deg": "Largest turn of a frame's gaze up or down, deg.",
    "diffraction": "Compute PSFs by geometrical optics, without diffraction.",
    "chromatic": "Focus all colors alike, without chromatic aberration.",
}


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command an option for each field of its argument, a dataclass.

    Annotate fields like parameters of a command.  Commands that share options derive
    their dataclasses from a common base.  Required options are listed first, and those
    of the base last.
    """
    record = get_type_hints(command)["options"]
    hints = get_type_hints(record, include_extras=True)
    own = inspect.get_annotations(record)

    def place(field: Field[Any]) -> tuple[bool, bool]:
        return field.default is not MISSING, field.name not in own

    options = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty
            if field.default is MISSING
            else field.default,
            annotation=hints[field.name],
        )
        for field in sorted(fields(record), key=place)
    ]
    return _expanded(command, "options", options, lambda given: record(**given))


def with_setting_options(
    **defaults: Any,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add an option for each setting to a command.

    The command receives their values as the argument ``settings``, a dict.

    Parameters
    ----------
    **defaults
        Settings whose default differs from the service's.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        options = [
            option
            for name in setting_types()
            if "_range_" not in name and name != "object_planes_dpt"
            for option in _options(name, defaults.get(name, getattr(DEFAULTS, name)))
        ]
        return _expanded(command, "settings", options, _settings)

    return decorated


def _expanded(
    command: Callable[..., None],
    name: str,
    options: list[inspect.Parameter],
    value_of: Callable[[dict[str, Any]], Any],
) -> Callable[..., None]:
    """Replace one parameter of a command with several options.

    Parameters
    ----------
    command : callable
    name : str
        The parameter.
    options : list of inspect.Parameter
    value_of : callable
        Function that maps the values of the options to the value of the parameter.
    """

    @functools.wraps(command)
    def run(**values: Any) -> None:
        given = {option.name: values.pop(option.name) for option in options}
        command(**values, **{name: value_of(given)})

    own = inspect.signature(command, eval_str=True).parameters
    parameters = [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for parameter in own.values()
        for each in (options if parameter.name == name else [parameter])
    ]
    cast(Any, run).__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _options(name: str, default: Any) -> list[inspect.Parameter]:
    """Return the typer parameters of one setting."""
    kind = get_args(setting_types()[name])[0]
    help_text = OPTION_HELP.get(name) or setting_help(name)
    if isinstance(default, bool):
        flag = f"--{'no-' if default else ''}{name.replace('_', '-')}"
        return [_option(name, bool, default=False, help_text=help_text, flags=(flag,))]
    if isinstance(default, tuple):
        stem, _, unit = name.rpartition("_")
        return [
            _option(
                f"{stem}_{side}_{unit}",
                float,
                default=value,
                help_text=OPTION_HELP[f"{stem}_{side}_{unit}"],
            )
            for side, value in zip(SIDES, default, strict=True)
        ]
    return [_option(name, _plain_type(kind), default=default, help_text=help_text)]


def _option(
    name: str, kind: Any, *, default: Any, help_text: str, flags: tuple[str, ...] = ()
) -> inspect.Parameter:
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, typer.Option(*flags, help=help_text)],
    )


def _plain_type(kind: Any) -> Any:
    """Return a type without its limits, which `FilterSettings` checks."""
    if hasattr(kind, "__metadata__"):
        return kind.__origin__
    parts = get_args(kind)
    if type(None) in parts:
        return _plain_type(parts[0]) | None
    return kind


def _settings(given: dict[str, Any]) -> dict[str, Any]:
    """Convert values of options to values of settings.

    Raises
    ------
    ValueError
        If a value is invalid.  The message names the option, the value and the range.
    """
    found = {}
    for name, kind in setting_types().items():
        stem, _, unit = name.rpartition("_")
        sides = [f"{stem}_{side}_{unit}" for side in SIDES]
        if name in given:
            value = given[name]
            if isinstance(getattr(DEFAULTS, name), bool) and getattr(DEFAULTS, name):
                value = not value
            names = [name]
        elif all(side in given for side in sides):
            value, names = tuple(given[side] for side in sides), sides
        else:
            continue
        if name == "display" and str(value).endswith(".csv"):
            value = display_of_file(value)
        try:
            found[name] = checked(value, kind, name)
        except BadMessage as error:
            at = names[1 if str(error.field).endswith("[1]") else 0]
            option = f"--{at.replace('_', '-')}"
            raise ValueError(
                f"{option}: {error.message}; allowed: {error.allowed}"
            ) from None
    return found


def read_profile(text: str, option: str = "--profile") -> dict[str, Any]:
    """Return a profile from JSON text, a file, or the name of an eye.

    A file has one of `PROFILE_SUFFIXES`.  The service resolves preset names; its fields
    are not validated here.

    Raises
    ------
    ValueError
        If the profile cannot be read.  The message names the option and the file.
    """
    from estimator import profile_body  # the reader of profiles takes 40 ms

    try:
        return profile_body(text)
    except InvalidFile as error:
        name = option.removeprefix("--")
        raise InvalidFile(text, error.found, error.allowed, name) from None
    except ValueError as error:
        shown = printable(text, most=MAX_TITLE_CHARACTERS)
        raise ValueError(f"{option} {shown}: {error}") from None


def profile_title(profile: Mapping[str, Any]) -> str:
    """Return a profile's name, or its kind, as text for a message."""
    name = str(profile.get("name", profile.get("kind")))
    return printable(name, most=MAX_TITLE_CHARACTERS)


def read_object(option: str, text: str) -> dict[str, Any]:
    """Parse a JSON object from the command line."""
    try:
        data = text.encode("utf-8", "surrogateescape")
        value = loads_bounded(data, max_bytes=MAX_ARGUMENT_BYTES)
    except ValueError as error:
        raise ValueError(f"{option} is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{option} is {value!r:.60}; allowed: a JSON object")
    return value


def read_size_px(text: str, option: str = "--size") -> tuple[int, int]:
    """Return width and height in px from text such as ``1280x720``.

    Raises
    ------
    ValueError
        If these are not two integers of at least 16.  The message names the option.
    """
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() and int(p) >= 16 for p in parts):
        raise ValueError(
            f"{option} is {text!r}; allowed: WIDTHxHEIGHT, 16 px or more each"
        )
    return int(parts[0]), int(parts[1])


MAX_DISPLAY_BYTES = 1_000_000
"""Size limit of a file of spectra; steps of 0.1 nm from 300 to 1100 nm take 0.4 MB."""

MAX_VALUE = 1e30
"""Largest number in such a file; sums and products stay within float64."""


def display_of_file(name: str) -> str:
    """Return the setting `display` for a file of measured spectra.

    Parameters
    ----------
    name : str
        Path of a file for `read_spectra`.

    Raises
    ------
    InvalidFile
        If the file is invalid.  The message names the file and the problem.
    """
    return display_of_spectra(name, read_spectra(name), option="display")


def display_of_spectra(name: str, spectra: DisplaySpectra, *, option: str) -> str:
    """Return the setting `display` for the spectra of a file, whose name errors have.

    Raises
    ------
    InvalidFile
        If the spectra are not three independent colors.
    """
    try:
        with np.errstate(all="ignore"):  # primaries_of_spectra rejects zeros
            primaries = primaries_of_spectra(*spectra)
    except ValueError as error:
        _refuse(name, str(error), "measured spectra of three primaries", option)
    return ",".join(
        f"{nm:.1f}:{width_nm:.1f}" for nm, width_nm in zip(*primaries, strict=True)
    )


def read_spectra(name: str, *, option: str = "display") -> DisplaySpectra:
    """Return the spectra of a display in a file.

    Parameters
    ----------
    name : str
        Path of a .csv file with the columns wavelength in nm, red, green and blue.  A
        header line is skipped; wavelengths must be evenly spaced.
    option : str
        Name of the command-line option, for errors.

    Raises
    ------
    InvalidFile
        If the file is invalid.  The message names the file and the problem.
    """
    text = read_text(Path(name), max_bytes=MAX_DISPLAY_BYTES, option=option)
    lines = text.split("\n")
    try:
        table = np.array(
            [
                [float(part) for part in line.split(",")]
                for number, line in enumerate(lines)
                if line.strip() and not (number == 0 and _is_header(line))
            ]
        )
        found = DisplaySpectra(table[:, 0], table[:, 1:])
    except (ValueError, IndexError):
        _refuse(name, "a line without four numbers", "nm, red, green, blue", option)
    if not np.abs(table).max() <= MAX_VALUE:
        _refuse(name, "a number is too large", f"at most {MAX_VALUE:g}", option)
    steps_nm = np.diff(found.wavelengths_nm)
    if not (steps_nm.size and np.allclose(steps_nm, steps_nm[0]) and steps_nm[0] > 0):
        _refuse(name, "wavelengths are not evenly spaced", "even steps", option)
    return found


def _refuse(name: str, found: str, allowed: str, option: str) -> NoReturn:
    raise InvalidFile(name, found, allowed, option) from None


def _is_header(line: str) -> bool:
    try:
        float(line.split(",")[0])
    except ValueError:
        return True
    return False
