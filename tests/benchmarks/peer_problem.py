"""What every peer of `bench_peers` is given, what it has to offer, and ours.

A module of peers has ``PEERS``.  Each is opened with a problem (a view, an eye on its
axis) and then filters frames at states of that eye.  What a state needs it makes when
the state is new and keeps while the state stays.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.profiles.parse import parse_profile
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.view_sources import EyeState, linear_color, view_sources
from tests.grid_specs import grid_spec

LAYER_COUNT = 41
"""Layers of the methods that cut a view into them, as Csoba & Kunkli 2023, 7.2.1, gave
Barsky's."""

RANGES = {"pupil_range_mm": (2.0, 7.0), "focus_range_dpt": (0.0, 3.0)}
"""What ours is prepared for, as for a stream whose pupil and focus change."""

DISTANCE_STEP_DPT = 0.25


class NotInstalled(Exception):
    """A peer that this machine does not have; the message says what is missing."""


@dataclass(frozen=True)
class Problem:
    """A view, and an eye that looks at it.

    Attributes
    ----------
    profile : dict
        As a client sends it.
    settings : dict
        Settings that differ from those of an on-axis stream.
    """

    view: RgbdView
    profile: dict
    settings: dict = field(default_factory=dict)

    @cached_property
    def spec(self) -> GridSpec:
        """The camera and what ours is prepared for."""
        return self.spec_with()

    def spec_with(self, **settings) -> GridSpec:
        """The same with other settings."""
        nearest = np.ceil(self._distance_range_dpt[1] / DISTANCE_STEP_DPT)
        return grid_spec(
            self.view.camera,
            **{
                **RANGES,
                "object_range_dpt": (0.0, float(DISTANCE_STEP_DPT * max(nearest, 1))),
                **self.settings,
                **settings,
            },
        )

    @cached_property
    def eye(self):
        """Optics for all states."""
        return eye_for_spec(parse_profile(self.profile), self.spec)[0]

    def state(self, *, pupil_diameter_mm: float, focus_dpt: float) -> EyeState:
        """The eye at a pupil and focus."""
        return EyeState(self.eye, self.spec, pupil_diameter_mm, focus_dpt)

    @cached_property
    def color(self) -> NDArray[np.float32]:
        """Linear light (height, width, 3)."""
        return linear_color(self.view).astype(np.float32)

    @cached_property
    def distance_dpt(self) -> NDArray[np.float64]:
        """Of each pixel (height, width)."""
        spec = grid_spec(self.view.camera)
        found = view_sources(self.view, spec).distance_dpt
        return found.reshape(self.view.depth_m.shape)

    @property
    def _distance_range_dpt(self) -> tuple[float, float]:
        return float(self.distance_dpt.min()), float(self.distance_dpt.max())

    def layers_dpt(self) -> NDArray[np.float64]:
        """Distances (n,) of layers, uniform in dioptres over the view."""
        return np.linspace(*self._distance_range_dpt, LAYER_COUNT)

    def disc_radius_px(self, state: EyeState, distance_dpt) -> NDArray[np.float64]:
        """Blur radius of green light by geometrical optics."""
        defocus_dpt = self.defocus_dpt(state) + distance_dpt
        return np.abs(defocus_dpt) * self.spec.blur_px_per_dpt(state.pupil_diameter_mm)

    def defocus_dpt(self, state: EyeState) -> float:
        """Total defocus of green light from infinity."""
        zero = np.zeros(1)
        at_infinity = state.wavefront_arguments(zero, zero, zero)
        return float(at_infinity["total_defocus_dpt"][1])


@dataclass(frozen=True)
class Peer:
    """A method of the table.

    Attributes
    ----------
    differs : str
        How it composes, and what it cannot do.
    open : callable
        From a problem to a function of an `EyeState` that gives back linear light
        (height, width, 3); raises `NotInstalled`.  A function with an attribute
        ``own_ms`` says itself how long its last frame took.
    frames_per_call : int
        How many frames one call filters; times are per frame.
    """

    name: str
    differs: str
    open: Callable[[Problem], Callable[[EyeState], NDArray]]
    frames_per_call: int = 1


class KeptForState:
    """What a state needs, made when the state is new."""

    def __init__(self, make: Callable[[EyeState], object]):
        self._make = make
        self._of: tuple[float, float] | None = None
        self._kept: object = None

    def get(self, state: EyeState):
        """Return what was made of this state."""
        key = (state.pupil_diameter_mm, state.focus_dpt)
        if self._of != key:
            self._kept, self._of = self._make(state), key
        return self._kept


@dataclass(frozen=True)
class Variant:
    """Settings of ours that make a row of their own, as points of time and error.

    Attributes
    ----------
    label : str
        Behind the name of the engine.
    settings : dict
        Of the store, as ``{"tolerance": "fine"}``.
    options : dict
        Of each frame, as ``{"merge": False}``.
    """

    label: str = ""
    settings: dict = field(default_factory=dict)
    options: dict = field(default_factory=dict)


TOLERANCES = (0.0, 0.05, 0.2, 1.0, 3.0, 8.0)
"""From exact to fast: the curve of time against error."""

UNCUT = {"kept_energy_ratio": 0.997}
"""Kernels that keep more of their tails than a stream's, as one picture's do."""

VARIANTS = (
    *(
        Variant(f"tolerance {tolerance:g}", options={"render_tolerance": tolerance})
        for tolerance in TOLERANCES
    ),
    *(
        Variant(f"{tolerance:g}, wider", UNCUT, {"render_tolerance": tolerance})
        for tolerance in (0.05, 0.2)
    ),
)

FINE = {"mode": "quality", "tolerance": "fine"}

FIELD_VARIANTS = (
    Variant("dynamic", {"mode": "dynamic"}),
    Variant("quality", {"mode": "quality"}),
    Variant("quality, fine", FINE),
    Variant("fine, wider", {**FINE, **UNCUT}),
)
"""For PSFs that follow the visual field, whose spacing decides on time and error."""


def ours(renderer, variant: Variant):
    """Open a renderer with a store for all pupils and foci."""

    def opened(problem: Problem):
        spec = problem.spec_with(**variant.settings)
        handle = renderer.load(build_psf_store(problem.eye, spec))

        def frame(state: EyeState) -> NDArray:
            return renderer.render(
                problem.view,
                handle,
                pupil_diameter_mm=state.pupil_diameter_mm,
                focus_dpt=state.focus_dpt,
                **variant.options,
            ).color

        return frame

    return opened
