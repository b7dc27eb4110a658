"""Timed frames of a renderer, in a state that changes with every frame or stays.

In a stream pupil and focus change all the time, so a frame's kernels are blended anew;
that is what `timed_frames` measures.  Its states come ever nearer to the one that is
asked for and end there, no two alike, so that the last picture can be judged by the
reference of that very state.  A state that stays ("frozen") leaves each frame the
kernels of the one before.
"""

import time
from dataclasses import dataclass

import numpy as np

from filter_service.planning.grid import GridSpec

CHANGE = 1e-3
"""Of pupil (mm), focus (dpt) and gaze (degrees) over a run: too little to be seen."""

WARM_UPS = 1


@dataclass(frozen=True)
class FrameRun:
    """Frames after the warm-up, and the wall time of each.

    Attributes
    ----------
    frames : list of ViewResult
        The last is of the very state that was asked for.
    times_ms : (n,)
    """

    frames: list
    times_ms: list[float]

    @property
    def last(self):
        """The frame to judge."""
        return self.frames[-1]

    @property
    def median_ms(self) -> float:
        """Median time."""
        return float(np.median(self.times_ms))

    @property
    def p95_ms(self) -> float:
        """95th percentile of the times."""
        return float(np.percentile(self.times_ms, 95))


def timed_frames(
    renderer,
    view,
    handle,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    repeats: int,
    frozen: bool = False,
    **options,
) -> FrameRun:
    """Render a view after a warm-up; ``options`` are those of `render`."""
    count = WARM_UPS + repeats
    states = states_towards(
        handle.store.spec, pupil_diameter_mm, focus_dpt, 1 if frozen else count
    )
    states = states * count if frozen else states
    frames, times_ms = [], []
    for state in states:
        start_s = time.perf_counter()
        frames.append(renderer.render(view, handle, **state, **options))
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return FrameRun(frames[WARM_UPS:], times_ms[WARM_UPS:])


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
