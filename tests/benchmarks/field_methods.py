"""All methods of `bench_field` on one footing: a view and a state in, an image out."""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from filter_service.planning.grid import GridSpec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.frame_runs import WARM_UPS, timed_frames
from tests.benchmarks.layered_baselines import Filtered, barsky, celaya, gonzalez
from tests.benchmarks.paper_baselines import (
    paper_dynamic,
    paper_on_axis,
    paper_quality,
    predecessor,
)
from tests.benchmarks.view_sources import EyeState
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye

PERIPHERY = "model"
"""The paper's eyes: their periphery follows from their surfaces, a sphere as retina."""

PUPIL_RANGE_MM = (2.0, 7.0)
FOCUS_RANGE_DPT = (0.0, 3.0)
PAPER_RANGES = {"pupil_range_mm": (2.0, 6.0), "focus_range_dpt": (0.125, 4.125)}

DISTANCE_STEP_DPT = 0.25
"""Ranges of object distances are rounded up to this."""


@dataclass(frozen=True)
class State:
    """What a frame asks of the eye."""

    pupil_mm: float
    focus_dpt: float

    def __str__(self) -> str:
        return f"{self.pupil_mm:.2f} mm {self.focus_dpt:.2f} dpt"


@dataclass(frozen=True)
class Method:
    """A way to filter a view.

    Attributes
    ----------
    name : str
    on_axis : bool
        Which reference it aims at: one PSF per distance, or the whole visual field.
    any_state : bool
        Whether pupil and focus may be anything without a new preparation.
    timed : bool
        Whether its frames are timed, all alike: after a warm-up, several times.  Others
        are written to be right and not to be fast; their work is counted.
    """

    name: str
    on_axis: bool
    any_state: bool
    timed: bool = field(default=True, kw_only=True)

    def states(self, fixed: State, others: list[State]) -> list[State]:
        """States that it is measured in."""
        return [fixed, *others] if self.any_state else [fixed]


class EyeBench:
    """One eye before one camera: states for references, and stores for the renderer."""

    def __init__(self, renderer, name: str, views: list[RgbdView]):
        self.renderer, self._name = renderer, name
        self._camera = {
            "width_px": views[0].width_px,
            "height_px": views[0].height_px,
            "tangents": views[0].tangents,
        }
        nearest_dpt = max(
            object_dpt(view, fill_missing_depth(view.depth_m)[0]).max()
            for view in views
        )
        steps = np.ceil(nearest_dpt / DISTANCE_STEP_DPT)
        self._object_range_dpt = (0.0, float(DISTANCE_STEP_DPT * steps))
        self._stores = {}

    def spec(self, mode: str, **settings) -> GridSpec:
        """Spec for this camera and these depths."""
        settings = {"object_range_dpt": self._object_range_dpt, **settings}
        return grid_spec(**self._camera, mode=mode, **settings)

    def exact_state(self, state: State, *, on_axis: bool) -> EyeState:
        """Eye traced for this very pupil and focus."""
        spec = self.spec(
            "on-axis" if on_axis else "quality",
            pupil_range_mm=(state.pupil_mm,) * 2,
            focus_range_dpt=(state.focus_dpt,) * 2,
        )
        eye = traced_eye(self._name, spec, periphery=PERIPHERY)
        return EyeState(eye, spec, state.pupil_mm, state.focus_dpt)

    def grid_state(self, state: State) -> EyeState:
        """Eye traced as far as the paper's grids reach, in angle, pupil and focus."""
        spec = self.spec("quality", grid="paper", **PAPER_RANGES)
        eye = traced_eye(self._name, spec, periphery=PERIPHERY)
        return EyeState(eye, spec, state.pupil_mm, state.focus_dpt)

    def store(self, method: "Ours", state: State):
        """Store of a method of ours, loaded, and how long it took to build."""
        settings = method.settings(state)
        key = tuple(settings.values())
        if key not in self._stores:
            spec = self.spec(**settings)
            eye = traced_eye(self._name, spec, periphery=PERIPHERY)
            start_s = time.perf_counter()
            store = build_psf_store(eye, spec)
            build_ms = 1e3 * (time.perf_counter() - start_s)
            self._stores[key] = (self.renderer.load(store), build_ms)
        return self._stores[key]

    def release(self) -> None:
        """Free what the renderer holds of the stores."""
        for handle, _ in self._stores.values():
            handle.release()
        self._stores.clear()


@dataclass(frozen=True)
class Ours(Method):
    """The renderer, with a store for the fixed state or for all states."""

    mode: str = "dynamic"
    grid: str = "planned"
    tolerance: str = "normal"

    def settings(self, state: State) -> dict:
        """Settings of its store."""
        ranges = {"pupil_range_mm": PUPIL_RANGE_MM, "focus_range_dpt": FOCUS_RANGE_DPT}
        if self.grid == "paper":
            ranges = PAPER_RANGES
        elif not self.any_state:
            ranges = {
                "pupil_range_mm": (state.pupil_mm,) * 2,
                "focus_range_dpt": (state.focus_dpt,) * 2,
            }
        how = {"mode": self.mode, "grid": self.grid, "tolerance": self.tolerance}
        return how | ranges

    def run(self, bench: EyeBench, view: RgbdView, state: State, repeats: int) -> list:
        """Filter ``repeats`` times after a warm-up; list of `Filtered`."""
        handle, build_ms = bench.store(self, state)
        frames, times_ms = timed_frames(
            bench.renderer,
            view,
            handle,
            pupil_diameter_mm=state.pupil_mm,
            focus_dpt=state.focus_dpt,
            repeats=repeats,
        )
        return [
            Filtered(
                color=frame.color,
                prepare_ms=build_ms,
                render_ms=time_ms,
                memory_mb=handle.store.memory_mb,
                psf_count=handle.store.psf_count,
            )
            for frame, time_ms in zip(frames, times_ms, strict=True)
        ]


@dataclass(frozen=True)
class Baseline(Method):
    """A function of `layered_baselines` or `paper_baselines`."""

    function: object = None
    options: tuple = ()
    needs_whole_grid: bool = False

    def run(self, bench: EyeBench, view: RgbdView, state: State, repeats: int) -> list:
        """Filter once, or where it is timed ``repeats`` times after a warm-up.

        A frame of another state needs its PSFs first: its time is that of both.
        """

        if self.needs_whole_grid:
            at = bench.grid_state(state)
        else:
            at = bench.exact_state(state, on_axis=self.on_axis)
        count, first = (WARM_UPS + repeats, WARM_UPS) if self.timed else (1, 0)
        found = [self.function(view, at, **dict(self.options)) for _ in range(count)]
        return [replace(r, render_ms=r.prepare_ms + r.render_ms) for r in found[first:]]


def _counted(name, *arguments, **options) -> Baseline:
    return Baseline(name, *arguments, **options, timed=False)


METHODS = (
    Ours("ours on-axis", on_axis=True, any_state=False, mode="on-axis"),
    Ours("ours on-axis wide", on_axis=True, any_state=True, mode="on-axis"),
    Ours("ours quality", on_axis=False, any_state=False, mode="quality"),
    Ours("ours dynamic", on_axis=False, any_state=True),
    Ours("ours dynamic fine", on_axis=False, any_state=True, tolerance="fine"),
    Baseline("Barsky", True, False, barsky),
    Baseline("Celaya", False, False, celaya),
    Baseline("Gonzalez", False, False, gonzalez),
    _counted("predecessor", True, False, predecessor),
    _counted("paper on-axis", True, False, paper_on_axis),
    _counted("paper alpha 1 tap", True, False, paper_on_axis, (("rule", "paper"),)),
    _counted("paper quality", False, False, paper_quality, (), True),
    _counted("paper dynamic", False, True, paper_dynamic, (), True),
)
