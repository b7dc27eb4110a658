"""Stimuli: time to draw them, their sizes in the pixels, and a set seen by people.

- ``letters``: heights of straight-ended letters, as the ink of each row, less the
  heights that were asked for, in percent; the largest of 12 heights from 5 to 60 arcmin
  and of 3 sizes of pixels.
- ``areas``: heights of optotypes that follow from their area and closed forms.
- ``gratings``: period and contrast of sinusoids, by a fit to the pixels.
- ``text``: height of an x, as the ink of each row.
- ``seen``: contrasts of gratings of 4 to 20 cpd as one drawn person sees them with a
  pupil of 3 mm, in red, green and blue, less the MTF of `Eye` times their contrast; at
  render tolerances 0 (default of the command) and 1.
- ``set``: 10 stimuli, 20 drawn persons and 2 pupils by one command, and the number of
  frames that report a limit of blur (`blur_limited`).
"""

import json
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from ocufilter import Eye, EyeFilter, stimuli
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.commands import run_command
from tests.numerical.test_stimuli import (
    AREAS,
    display,
    extent_arcmin,
    fitted_wave,
    ink,
    seen_and_expected,
)

MINUTES = 1
PIXELS_ARCMIN = (0.25, 0.37, 0.5)
HEIGHTS_ARCMIN = np.linspace(5.0, 60.0, 12).tolist()
SIDE_PX = 256
SET = (
    *("--letters", "CDHK", "--height-arcmin", "10", "--landolt-c", "0,90"),
    *("--grating-cpd", "4,8", "--square-cpd", "4", "--gabor-cpd", "6"),
    *("--gabor-sd-arcmin", 8, "--pixel-arcmin", 0.5, "--size", "96x96"),
    *("--distance-m", 4, "--pupil-mm", "3,5"),
    *("-p", 'p={"kind": "prescription", "sphere_dpt": 0}'),
)


def _row(method, case, times_s, name, error, reference) -> Row:
    times_ms, size = 1e3 * np.array(times_s), f"{SIDE_PX}x{SIDE_PX}"
    return row_of("stimuli", method, case, size, times_ms, name, error, reference)


def _sizes(draw, measure, heights_arcmin) -> tuple[list[float], float]:
    """Return times and the largest error of heights, %."""
    times_s, errors = [], []
    for pixel_arcmin in PIXELS_ARCMIN:
        pixels = display(pixel_arcmin, width_px=SIDE_PX, height_px=SIDE_PX)
        for height_arcmin in heights_arcmin:
            start_s = time.perf_counter()
            found = draw(height_arcmin, pixels)
            times_s.append(time.perf_counter() - start_s)
            errors.append(abs(measure(found) / height_arcmin - 1.0))
    return times_s, 100.0 * max(errors)


def size_rows(heights_arcmin) -> list[Row]:
    """Return a row for each kind of letter."""
    rows = []
    for letter in "DEHKNZ":

        def draw(height_arcmin, pixels, letter=letter):
            size = {"height_arcmin": height_arcmin, "display": pixels}
            if letter == "E":
                return stimuli.tumbling_e(0.0, **size)
            return stimuli.sloan_letters(letter, **size)

        times_s, error = _sizes(draw, lambda one: extent_arcmin(one, 0), heights_arcmin)
        rows.append(
            _row("letters", letter, times_s, "height_percent", error, "height asked")
        )
    for letter, turn_deg in (("C", 0.0), ("C", 45.0), ("C", 17.0), ("E", 90.0)):

        def turned(height_arcmin, pixels, letter=letter, turn_deg=turn_deg):
            draw = stimuli.landolt_c if letter == "C" else stimuli.tumbling_e
            return draw(turn_deg, height_arcmin=height_arcmin, display=pixels)

        def from_area(one, letter=letter):
            area = ink(one).sum() * one.display.pixel_arcmin**2
            return 5.0 * math.sqrt(area / AREAS[letter])

        times_s, error = _sizes(turned, from_area, heights_arcmin)
        case = f"{letter} at {turn_deg:g} deg"
        rows.append(
            _row("areas", case, times_s, "height_percent", error, "closed form")
        )
    times_s, error = _sizes(
        lambda height_arcmin, pixels: stimuli.reading_text(
            "xx", x_height_arcmin=height_arcmin / 2.0, display=pixels
        ),
        lambda one: 2.0 * extent_arcmin(one, 0),
        [height for height in heights_arcmin if height >= 20.0 and height <= 40.0],
    )
    rows.append(_row("text", "xx", times_s, "x_height_percent", error, "height asked"))
    return rows


def grating_rows(frequencies_cpd) -> list[Row]:
    """Return rows of the period and of the contrast."""
    times_s, periods, contrasts = [], [], []
    for pixel_arcmin in PIXELS_ARCMIN:
        pixels = display(pixel_arcmin, width_px=SIDE_PX, height_px=SIDE_PX)
        for frequency_cpd in frequencies_cpd:
            for orientation_deg in (0.0, 30.0):
                start_s = time.perf_counter()
                found = stimuli.grating(
                    frequency_cpd,
                    display=pixels,
                    orientation_deg=orientation_deg,
                    phase_deg=20.0,
                    contrast=0.4,
                )
                times_s.append(time.perf_counter() - start_s)
                angle = math.radians(orientation_deg)
                guess = np.array([math.cos(angle), math.sin(angle)])
                guess *= 1.0005 * frequency_cpd * pixel_arcmin / 60.0
                mean, amplitude, right, up, _ = fitted_wave(
                    found.light.astype(float), guess
                )
                period_arcmin = pixel_arcmin / math.hypot(right, up)
                periods.append(abs(period_arcmin * frequency_cpd / 60.0 - 1.0))
                contrasts.append(abs(abs(amplitude) / mean / 0.4 - 1.0))
    return [
        _row("gratings", case, times_s, name, 100.0 * max(errors), "fit to the pixels")
        for case, name, errors in (
            ("period", "period_percent", periods),
            ("contrast", "contrast_percent", contrasts),
        )
    ]


def seen_rows(frequencies_cpd) -> list[Row]:
    """Return rows of the contrast that an eye sees, for two render tolerances."""
    body = {"kind": "prescription", "sphere_dpt": 0.0, "sample": 0}
    eye, rows = Eye(body), []
    camera = display(0.5, width_px=160, height_px=160).camera
    with EyeFilter(body, camera, engine="native") as eye_filter:
        eye_filter.wait()
        for render_tolerance in (0.0, 1.0):
            times_s, errors = [], []
            for frequency_cpd in frequencies_cpd:
                for orientation_deg in (0.0, 30.0):
                    start_s = time.perf_counter()
                    found, expected = seen_and_expected(
                        *(eye_filter, eye, frequency_cpd, orientation_deg),
                        render_tolerance=render_tolerance,
                    )
                    times_s.append(time.perf_counter() - start_s)
                    errors.append(np.abs(found - expected).max())
            case = f"render tolerance {render_tolerance:g}"
            rows.append(
                _row("seen", case, times_s, "contrast_error", max(errors), "Eye.mtf")
            )
    return rows


def set_row(people: int) -> Row:
    """Return the time of a set, and its false alarms."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set"
        start_s = time.perf_counter()
        finished = run_command("stimuli", *SET, "--people", people, "-o", out)
        took_s = time.perf_counter() - start_s
        assert finished.returncode == 0, finished.stderr
        lines = (out / "manifest.jsonl").read_text().splitlines()[1:]
    frames = [json.loads(line) for line in lines]
    alarms = sum("largest kernel" in " ".join(one["notes"]) for one in frames)
    case = f"{len(frames)} frames, {took_s:.0f} s"
    return _row("set", case, [took_s / len(frames)], "false_alarms", alarms, "0")


def measure(run: Run) -> list[Row]:
    """Return the rows of all kinds, or of few sizes and persons."""
    heights = HEIGHTS_ARCMIN[3:4] if run.is_quick else HEIGHTS_ARCMIN
    frequencies = (8.0,) if run.is_quick else (2.0, 5.5, 12.0, 30.0, 55.0)
    rows = size_rows(heights) + grating_rows(frequencies)
    rows += seen_rows((12.0,) if run.is_quick else (4.0, 8.0, 12.0, 20.0))
    return [*rows, set_row(2 if run.is_quick else 20)]
