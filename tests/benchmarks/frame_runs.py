"""Timed frames of a renderer in a state that changes with every frame.

In a stream pupil and focus change all the time, so a frame's kernels are blended anew;
that is what `timed_frames` measures.  Its states come ever nearer to the one that is
asked for and end there, no two alike, so that the last picture can be judged by the
reference of that very state.
"""

import time

from filter_service.planning.grid import GridSpec

CHANGE = 1e-3
"""Of pupil (mm), focus (dpt) and gaze (degrees) over a run: too little to be seen."""

WARM_UPS = 1


def timed_frames(
    renderer,
    view,
    handle,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    repeats: int,
    **options,
) -> tuple[list, list[float]]:
    """Render a view after a warm-up; return the frames and their times in ms.

    The last frame is of the requested state.  ``options`` are those of `render`.
    """
    frames, times_ms = [], []
    for state in states_towards(
        handle.store.spec, pupil_diameter_mm, focus_dpt, WARM_UPS + repeats
    ):
        start_s = time.perf_counter()
        frames.append(renderer.render(view, handle, **state, **options))
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return frames[WARM_UPS:], times_ms[WARM_UPS:]


def states_towards(
    spec: GridSpec, pupil_diameter_mm: float, focus_dpt: float, count: int
) -> list[dict]:
    """Arguments of `render` for frames that end at a state, each another.

    They stay within what a store was prepared for; one that was prepared for a single
    state takes that in place of each, but blends its kernels again all the same.  Gaze
    changes where it may, and the field with it.
    """
    settings = spec.settings
    towards = {
        "pupil_diameter_mm": _towards(
            pupil_diameter_mm, settings.pupil_range_mm[1], count
        ),
        "focus_dpt": _towards(focus_dpt, settings.focus_range_dpt[1], count),
    }
    if spec.follows_field and any(settings.gaze_range_deg):
        ends = [
            _towards(gaze, gaze + reach, count)
            for gaze, reach in zip(
                settings.gaze_deg, settings.gaze_range_deg, strict=True
            )
        ]
        towards["gaze_deg"] = list(zip(*ends, strict=True))
    return [{name: values[k] for name, values in towards.items()} for k in range(count)]


def _towards(value: float, highest: float, count: int) -> list[float]:
    """Values that end at one, from above it unless that is as high as they go."""
    sign = 1.0 if value + CHANGE <= highest else -1.0
    return [value + sign * CHANGE * (count - 1 - k) / count for k in range(count)]
