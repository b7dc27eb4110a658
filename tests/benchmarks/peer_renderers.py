"""Ours among its peers, and the sorted gather over the same kernels."""

from dataclasses import dataclass, field

from numpy.typing import NDArray

from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.view_state import State
from tests.benchmarks.peer_problem import KeptForState, Problem
from tests.benchmarks.view_sources import EyeState
from tests.reference import render_passes as reference


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


def sorted_gather(problem: Problem):
    """Open the gather in float64, which sorts what reaches each pixel."""
    store = build_psf_store(problem.eye, problem.spec)
    layers = KeptForState(
        lambda state: frame_layers(
            store, State(state.pupil_diameter_mm, state.focus_dpt)
        )
    )
    return lambda state: reference.gather(problem.view, store, layers.get(state))
