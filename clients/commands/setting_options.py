"""Command-line options generated from `FilterSettings`.

A choice becomes an option such as ``--mode``, and angles become ``--gaze-h-deg`` and
``--gaze-v-deg``.  A switch becomes ``--no-chromatic`` if it is on by default, and
``--lateral-color`` if it is off.  Ranges and planes have no option: commands derive
them from the image.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, cast, get_args

import typer

from clients.commands.display_file import display_of_file
from filter_service.errors import BadMessage
from filter_service.settings import DEFAULTS, setting_help, setting_types
from filter_service.validation import checked

DIRECTION_HELP = {"h": "to the right", "v": "upward"}


def with_setting_options(
    **defaults: Any,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add an option for each setting to a command.

    The command receives their values as the argument ``settings``, a dict.

    Parameters
    ----------
    **defaults
        Settings whose default differs from the service's.
    """

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(command).parameters
        options = [
            option
            for name in setting_types()
            if "_range_" not in name and name != "object_planes_dpt"
            for option in _options(name, defaults.get(name, getattr(DEFAULTS, name)))
        ]

        @functools.wraps(command)
        def run(**values: Any) -> Any:
            given = {o.name: values.pop(o.name) for o in options}
            return command(**values, settings=_settings(given))

        kept = [p for name, p in own.items() if name != "settings"]
        everything = [
            p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*kept, *options)
        ]
        cast(Any, run).__signature__ = inspect.Signature(everything)
        run.__annotations__ = {p.name: p.annotation for p in everything}
        return run

    return decorated


def _options(name: str, default: Any) -> list[inspect.Parameter]:
    """Return the typer parameters of one setting."""
    kind = get_args(setting_types()[name])[0]
    help_text = setting_help(name)
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
                help_text=f"{help_text}  This is the angle {DIRECTION_HELP[side]}.",
            )
            for side, value in zip(DIRECTION_HELP, default, strict=True)
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
    """Convert the values of options to those of settings.

    Raises
    ------
    ValueError
        If a value is invalid.  The message names the option, the value and the range.
    """
    found = {}
    for name, kind in setting_types().items():
        stem, _, unit = name.rpartition("_")
        sides = [f"{stem}_{side}_{unit}" for side in DIRECTION_HELP]
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
