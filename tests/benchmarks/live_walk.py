"""The demo's walk: frames, states of the eye, and what is right in one of them."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clients.pyrender_stream import path_settings
from clients.scene_renderer import PATHS, path_moments
from tests.benchmarks.dense_reference import dense_reference, has_reference
from tests.benchmarks.view_sources import EyeState, Window
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import scene_views
from tests.numerical.synthetic import psnr_db

SCENE = "courtyard"
JUDGED = 0.5
"""Part of the walk after which the frame stands whose error is measured."""

WARM_UP_COUNT = 2

WHOLE_PIXELS = 640 * 360
"""Largest frame that is judged as a whole."""

WINDOW_PX = 256


@dataclass(frozen=True)
class Walk:
    """Frames of one size, with the state of the eye in each."""

    size_px: tuple[int, int]
    views: tuple
    states: tuple

    @classmethod
    def of(cls, size_px: tuple[int, int], count: int) -> "Walk":
        """Return the demo's walk in so many frames."""
        views = scene_views(
            SCENE, width_px=size_px[0], height_px=size_px[1], count=count
        )
        states = tuple(
            {"pupil_diameter_mm": m.pupil_diameter_mm, "focus_dpt": m.focus_dpt}
            for m in path_moments(PATHS[SCENE], count)
        )
        return cls(size_px, views, states)

    def shortened(self, count: int | None) -> "Walk":
        """Only the first frames, for what is slow."""
        return replace(self, views=self.views[:count], states=self.states[:count])

    @property
    def judged(self) -> int:
        """Number of the frame whose error is measured."""
        return int(JUDGED * len(self.views))

    @property
    def camera(self) -> dict:
        """Size and tangents, as specs take them."""
        view = self.views[0]
        return {
            "width_px": view.width_px,
            "height_px": view.height_px,
            "tangents": view.tangents,
        }


def walk_times(
    renderer, handle, walk: Walk, tolerance: float
) -> tuple[list[float], dict[str, float]]:
    """Times of all frames, ms, and the median of each stage."""
    times_ms, stages_ms = [], []
    options = {"output": "srgb8", "render_tolerance": tolerance}
    for view, state in [*zip(walk.views, walk.states, strict=True)][:WARM_UP_COUNT]:
        renderer.render(view, handle, **state, **options)
    for view, state in zip(walk.views, walk.states, strict=True):
        start_s = time.perf_counter()
        frame = renderer.render(view, handle, **state, **options)
        times_ms.append(1e3 * (time.perf_counter() - start_s))
        stages_ms.append(frame.stage_times_ms)
    names = {name for stages in stages_ms for name in stages}
    medians = {
        name: float(np.median([stages.get(name, 0.0) for stages in stages_ms]))
        for name in sorted(names)
    }
    return times_ms, medians


@dataclass(frozen=True)
class Judge:
    """What is right in the judged frame of a walk, through one eye.

    Attributes
    ----------
    windows : list of Window or None
        Parts of the frame; None is the whole.
    truths : list of (height, width, 3) or None
        Of the windows; None where references are not there.
    """

    walk: Walk
    windows: list[Window | None]
    truths: list[NDArray[np.float64]] | None

    @classmethod
    def of(
        cls,
        walk: Walk,
        eye: str,
        *,
        compute: bool,
        windows: list[Window | None] | None = None,
    ) -> "Judge":
        """Read references, or compute those that lack; of the usual windows if None."""
        view, state = walk.views[walk.judged], walk.states[walk.judged]
        spec = grid_spec(
            **walk.camera,
            mode="quality",
            pupil_range_mm=(state["pupil_diameter_mm"],) * 2,
            focus_range_dpt=(state["focus_dpt"],) * 2,
            object_range_dpt=path_settings(SCENE)["object_range_dpt"],
        )
        exact = EyeState(traced_eye(eye, spec), spec, *state.values())
        windows = windows or judged_windows(walk.size_px)
        known = [has_reference(view, exact, bins=True, window=w) for w in windows]
        if not compute and not all(known):
            return cls(walk, windows, None)
        truths = [dense_reference(view, exact, bins=True, window=w) for w in windows]
        return cls(walk, windows, truths)

    def error_db(self, renderer, handle, tolerance: float) -> float:
        """PSNR in linear light; not a number without references."""
        if self.truths is None:
            return float("nan")
        seen = renderer.render(
            self.walk.views[self.walk.judged],
            handle,
            **self.walk.states[self.walk.judged],
            render_tolerance=tolerance,
        ).color
        parts = [seen if window is None else window.of(seen) for window in self.windows]
        return psnr_db(_pixels(parts), _pixels(self.truths))


def _pixels(parts: list[NDArray]) -> NDArray:
    return np.concatenate([part.reshape(-1, 3) for part in parts])


def judged_windows(size_px: tuple[int, int]) -> list[Window | None]:
    """Parts of a frame whose error is measured; None is the whole."""
    width_px, height_px = size_px
    if width_px * height_px <= WHOLE_PIXELS:
        return [None]
    middle_y = (height_px - WINDOW_PX) // 2
    corners = [
        ((width_px - WINDOW_PX) // 2, middle_y),
        (0, middle_y),
        (width_px - WINDOW_PX, height_px - WINDOW_PX),
    ]
    return [Window(x, y, WINDOW_PX, WINDOW_PX) for x, y in corners]
