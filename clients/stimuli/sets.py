"""Lists of stimuli from options, and their files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from clients.batch.manifest import write_whole
from clients.provenance import code_version, metadata_of
from clients.stimuli.display import Display
from clients.stimuli.letters import (
    landolt_c,
    reading_text,
    sloan_letters,
    tumbling_e,
)
from clients.stimuli.options import StimuliOptions, numbers
from clients.stimuli.patterns import edge, gabor, grating, noise
from clients.stimuli.stimulus import Stimulus
from filter_service.image_files import LINEAR_SUFFIXES, write_image

MAX_STIMULI = 2000
FEW_CODES = 16
"""Number of 8-bit codes below which a graded pattern shows steps."""


def stimuli_of(options: StimuliOptions, display: Display) -> list[Stimulus]:
    """Return the stimuli that the options describe, in all combinations of values.

    Raises
    ------
    ValueError
        If there are none or too many, or one cannot be drawn.
    """
    found: list[Stimulus] = []
    names: set[str] = set()
    for parts in (_letters, _text, _patterns, _noise):
        for one in parts(options, display):
            if one.name in names:
                raise ValueError(f"'{one.name}' is drawn twice; allowed: once")
            names.add(one.name)
            found.append(one)
            if len(found) > MAX_STIMULI:
                raise ValueError(f"more than {MAX_STIMULI} stimuli; allowed: fewer")
    if not found:
        raise ValueError(
            "no stimulus is given; allowed: --letters, --landolt-c, --tumbling-e, "
            "--grating-cpd, --square-cpd, --gabor-cpd, --edge, --text, --noise"
        )
    return found


def _needed(name: str, text: str | None, for_what: str) -> tuple[float, ...]:
    if text is None:
        option = name.replace("_", "-")
        raise ValueError(f"--{option} is not given, but {for_what} needs it")
    return numbers(name, text)


def _letters(options: StimuliOptions, display: Display) -> Iterator[Stimulus]:
    directions = {
        landolt_c: numbers("landolt_c", options.landolt_c),
        tumbling_e: numbers("tumbling_e", options.tumbling_e),
    }
    if not (options.letters or any(directions.values())):
        return
    heights = _needed("height_arcmin", options.height_arcmin, "an optotype")
    contrasts = numbers("letter_contrast", options.letter_contrast)
    for height_arcmin, contrast in product(heights, contrasts):
        common: dict[str, Any] = {
            "height_arcmin": height_arcmin,
            "display": display,
            "contrast": contrast,
            "background_light": options.background_light,
        }
        for letter in options.letters or "":
            yield sloan_letters(letter, **common)
        for draw, angles in directions.items():
            for direction_deg in angles:
                yield draw(direction_deg, **common)


def _text(options: StimuliOptions, display: Display) -> Iterator[Stimulus]:
    if options.text is None:
        return
    heights = _needed("x_height_arcmin", options.x_height_arcmin, "--text")
    contrasts = numbers("letter_contrast", options.letter_contrast)
    for x_height_arcmin, contrast in product(heights, contrasts):
        yield reading_text(
            options.text,
            x_height_arcmin=x_height_arcmin,
            display=display,
            font=options.font,
            contrast=contrast,
            background_light=options.background_light,
        )


def _patterns(options: StimuliOptions, display: Display) -> Iterator[Stimulus]:
    orientations = numbers("orientation_deg", options.orientation_deg)
    phases = numbers("phase_deg", options.phase_deg)
    contrasts = numbers("contrast", options.contrast)
    drawn: dict[str, Callable[..., Stimulus]] = {
        "grating_cpd": grating,
        "square_cpd": partial(grating, wave="square"),
        "gabor_cpd": partial(gabor, sd_arcmin=options.gabor_sd_arcmin),
    }
    for name, draw in drawn.items():
        frequencies = numbers(name, getattr(options, name))
        for frequency_cpd, orientation_deg, phase_deg, contrast in product(
            frequencies, orientations, phases, contrasts
        ):
            yield draw(
                frequency_cpd,
                display=display,
                orientation_deg=orientation_deg,
                phase_deg=phase_deg,
                contrast=contrast,
                mean_light=options.mean_light,
            )
    if options.edge:
        for orientation_deg, contrast in product(orientations, contrasts):
            yield edge(
                display=display,
                orientation_deg=orientation_deg,
                contrast=contrast,
                mean_light=options.mean_light,
            )


def _noise(options: StimuliOptions, display: Display) -> Iterator[Stimulus]:
    for seed in numbers("noise", options.noise):
        if seed != int(seed):
            raise ValueError(f"--noise is {seed:g}; allowed: integers")
        yield noise(
            int(seed),
            display=display,
            rms_contrast=options.noise_rms,
            exponent=options.noise_exponent,
            mean_light=options.mean_light,
        )


def write_stimulus(path: Path, one: Stimulus) -> dict[str, Any]:
    """Write the picture of a stimulus; return its size in bytes and its hash."""
    is_linear = path.suffix in LINEAR_SUFFIXES
    write = partial(
        write_image,
        image=one.linear_rgb if is_linear else one.srgb,
        metadata=metadata_of(
            code_version(),
            {"stimulus": one.described(), "pixel_arcmin": one.display.pixel_arcmin},
        ),
    )
    return write_whole(path, write)


def file_notes(one: Stimulus, suffix: str) -> tuple[str, ...]:
    """Return notes on the sampling of a stimulus and the format of its file."""
    parameters = one.parameters
    is_graded = parameters["kind"] in ("gabor", "noise")
    is_graded |= parameters.get("wave") == "sine"
    codes = int(np.ptp(one.srgb))
    if suffix in LINEAR_SUFFIXES or not is_graded or codes >= FEW_CODES:
        return one.notes
    return (
        *one.notes,
        f"its light spans {codes} steps of 8-bit sRGB; --format exr has no steps",
    )


def described(
    displays: Mapping[str, Display], stimuli: Mapping[str, Stimulus]
) -> dict[str, Any]:
    """Return the calibration of displays and the stimuli by file, for a manifest."""
    return {
        "displays": {name: one.described() for name, one in displays.items()},
        "stimuli": {name: one.described() for name, one in stimuli.items()},
    }
