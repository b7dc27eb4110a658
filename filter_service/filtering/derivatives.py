"""Derivatives of a frame's image by parameters of the state and of the profile.

They are central differences of operators at one and two steps to either side, whose
truncation error falls with the fourth power of the step.  The accuracy "normal" uses
the operators of frames with exact PSFs (a render tolerance of 0).  `STEPS` were chosen
between truncation and the errors of PSFs, which change with the state by up to 1e-5 of
white from layer to layer.  The accuracy "fine" uses kernels of 30 bits by quadrature at
distances that are the same in all states (`psfs.frozen_store`), with shorter steps.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.operator import (
    FilterOperator,
    frozen_layers,
    frozen_operator,
    views_of_depth,
)
from filter_service.filtering.planned_frame import PlannedFrame
from filter_service.psfs.frozen_store import FrozenLayers
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from filter_service.view_state import State

MULTIPLES = (-2, -1, 1, 2)
"""Multiples of the step at which a derivative reads the image."""

STEPS = {
    "pupil_diameter_mm": 0.04,
    "focus_dpt": 0.06,
    "gaze_h_deg": 0.3,
    "gaze_v_deg": 0.3,
}
"""Steps of the parameters of the state."""

PROFILE_STEPS = {
    "_dpt": 0.06,
    "_um": 0.04,
    "_mm": 0.02,
    "_mm3": 1.0,
    "_deg": 2.0,
    "_constant": 0.1,
    "_ratio": 0.005,
}
"""Steps of a profile's numbers, by the end of the name of their field."""

FINE_STEP_RATIO = 1 / 3
"""Steps with the accuracy "fine": the truncation error is a hundredth."""

ACCURACIES = ("normal", "fine")

PROFILE_PREFIX = "profile."

Point = tuple[dict[str, Any], dict[str, Any] | None]
"""State, and the profile if it differs."""


def image_derivatives(
    eye_filter: EyeFilter,
    color: ArrayLike,
    depth_m: NDArray[Any] | RgbdView | Sequence[RgbdView],
    parameters: Iterable[str],
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    gaze_deg: tuple[float, float] | None = None,
    profile: Mapping[str, Any] | None = None,
    accuracy: str = "normal",
    timeout_s: float = 120.0,
) -> dict[str, NDArray[np.float32]]:
    """Return the derivatives of an image by parameters of the state and the profile.

    The image is that of `EyeFilter.operator` with ``render_tolerance=0``.  A derivative
    is a difference of four such operators, each of which takes a second or more.  Their
    sum, weighted by a change of the parameters, is the directional derivative.  Their
    inner products with the gradient of a loss by the image are its gradient by the
    parameters.

    Derivatives exist where the image is a smooth function.  It is not where the eye
    reaches the end of its range: beyond the far point, accommodation does not change,
    and the derivative by focus is 0.  Depth is not a parameter, because the order of
    occlusion changes abruptly.

    With the accuracy "normal", the amplitudes of derivatives have errors of up to 1 %,
    single pixels of 0.3 to 3 %, those by gaze up to twice that: PSFs have errors that
    change with the state.  With "fine", most errors are below 0.1 %, but each PSF takes
    20 to 500 ms; there is one for each color, distance and direction of the field.
    Within a few pixels of an edge of depth, the image has kinks as a function of the
    state, and derivatives depend on the step.

    Parameters
    ----------
    eye_filter : EyeFilter
    color : (..., height, width, 3) floats
        One or more colors in linear light, as for `FilterOperator.forward`.
    depth_m : (height, width) float32, RgbdView, or sequence of RgbdView
        As for `EyeFilter.operator`.
    parameters : iterable of str
        "pupil_diameter_mm", "focus_dpt", "gaze_h_deg", "gaze_v_deg", and paths of
        numbers in the profile, such as "profile.sphere_dpt" or
        "profile.zernike_um.4,0".  Their names end in one of `PROFILE_STEPS`.
    pupil_diameter_mm, focus_dpt, gaze_deg, timeout_s
        As for `EyeFilter.filter`.
    profile : mapping, optional
        Profile of the filter as plain values, for derivatives by its numbers.
    accuracy : "normal" or "fine"
        "fine" requires diffraction and a lens without rings.

    Returns
    -------
    dict of (..., height, width, 3) float32
        Linear light per unit of each parameter.

    Raises
    ------
    BadMessage
        In addition to the errors of `EyeFilter.operator`: a parameter is unknown, or
        the difference reads a state outside the ranges of the settings (a ValueError,
        too).
    """
    settings = eye_filter.settings
    state = {
        "pupil_diameter_mm": pupil_diameter_mm,
        "focus_dpt": focus_dpt,
        "gaze_deg": settings.gaze_deg if gaze_deg is None else gaze_deg,
    }

    if accuracy not in ACCURACIES:
        raise BadMessage(
            f"{accuracy!r}", field="accuracy", allowed=" or ".join(ACCURACIES)
        )
    frames, step_ratio = _Frames(depth_m, timeout_s), 1.0
    if accuracy == "fine":
        frames.freeze(eye_filter, state)
        step_ratio = FINE_STEP_RATIO

    def operator_at(point: Point) -> FilterOperator:
        own_state, own_profile = point
        if own_profile is None:
            return frames.operator(eye_filter, own_state)
        with EyeFilter(
            own_profile, eye_filter.cameras, settings, builder=eye_filter.builder
        ) as other:
            return frames.operator(other, own_state)

    found = {}
    for name in dict.fromkeys(parameters):
        step, points = _points(name, state, profile, settings, step_ratio)
        low_2, low, high, high_2 = (
            _images(operator_at(point), np.asarray(color)).astype(np.float64)
            for point in points
        )
        slope = (8.0 * (high - low) - (high_2 - low_2)) / (12.0 * step)
        found[name] = slope.astype(np.float32)
    return found


class _Frames:
    """Operators of a frame at the states of a difference.

    Parameters
    ----------
    depth_m, timeout_s
        As of `image_derivatives`.
    """

    def __init__(
        self,
        depth_m: NDArray[Any] | RgbdView | Sequence[RgbdView],
        timeout_s: float,
    ) -> None:
        self._depth_m, self._timeout_s = depth_m, timeout_s
        self._frozen: list[FrozenLayers] | None = None

    def freeze(self, eye_filter: EyeFilter, state: Mapping[str, Any]) -> None:
        """Use the layers of a state for all states, with precise kernels."""
        planned = self._planned(eye_filter, state)
        self._frozen = [frozen_layers(view) for view in planned.views]

    def operator(
        self, eye_filter: EyeFilter, state: Mapping[str, Any]
    ) -> FilterOperator:
        """Return the operator at a state."""
        if self._frozen is None:
            return eye_filter.operator(
                self._depth_m,
                **state,
                render_tolerance=0.0,
                timeout_s=self._timeout_s,
            )
        planned = self._planned(eye_filter, state)
        is_sequence = not isinstance(self._depth_m, RgbdView | np.ndarray)
        return frozen_operator(planned, self._frozen, is_sequence=is_sequence)

    def _planned(self, eye_filter: EyeFilter, state: Mapping[str, Any]) -> PlannedFrame:
        views = views_of_depth(self._depth_m, next(iter(eye_filter.cameras), None))
        states = [State.checked(**state)] * len(views)
        while not (planned := eye_filter.plan(views, states, newest_only=True)):
            eye_filter.wait(self._timeout_s)
        return planned


def _images(operator: FilterOperator, color: NDArray[Any]) -> NDArray[np.float32]:
    """Return the images of one or more colors."""
    batch = color.shape[: max(color.ndim - len(operator.color_shape), 0)]
    colors = color.reshape(-1, *color.shape[len(batch) :])
    images = [operator.forward(own) for own in colors]
    return np.array(images, np.float32).reshape(*batch, *operator.image_shape)


def _points(
    name: str,
    state: Mapping[str, Any],
    profile: Mapping[str, Any] | None,
    settings: FilterSettings,
    step_ratio: float,
) -> tuple[float, list[Point]]:
    """Return the step of a parameter, and state and profile at each point."""
    if name in STEPS:
        step = step_ratio * STEPS[name]
        return step, [
            (_moved(state, name, k * step, settings), None) for k in MULTIPLES
        ]
    if not name.startswith(PROFILE_PREFIX):
        raise BadMessage(
            f"{name!r}",
            field="parameters",
            allowed=f"{', '.join(STEPS)}, or {PROFILE_PREFIX} and the path of a number",
        )
    if profile is None:
        raise BadMessage(
            f"it is missing, for {name!r}",
            field="profile",
            allowed="the profile of the filter as plain values",
        )
    keys = name.removeprefix(PROFILE_PREFIX).split(".")
    value = _number(profile, keys, name)
    ends = [(key, s) for key in reversed(keys) for s in PROFILE_STEPS.items()]
    step = next((step for key, (end, step) in ends if key.endswith(end)), 0.0)
    if not step:
        raise BadMessage(
            f"{name!r}",
            field="parameters",
            allowed=f"a number whose name ends in {', '.join(PROFILE_STEPS)}",
        )
    step *= step_ratio
    return step, [
        (dict(state), _with_number(profile, keys, value + k * step)) for k in MULTIPLES
    ]


def _moved(
    state: Mapping[str, Any], name: str, change: float, settings: FilterSettings
) -> dict[str, Any]:
    """Return a state with one parameter changed, which must be in the range."""
    h_deg, v_deg = state["gaze_deg"]
    values = {**state, "gaze_h_deg": h_deg, "gaze_v_deg": v_deg}
    axis = "hv".find(name.split("_")[1])
    if name.startswith("gaze"):
        if not settings.follows_field:
            raise BadMessage(
                f"{name!r} in mode {settings.mode}",
                field="parameters",
                allowed="gaze in the modes quality and dynamic",
            )
        middle, reach = settings.gaze_deg[axis], settings.gaze_range_deg[axis]
        low, high = middle - reach, middle + reach
        allowed = "gaze_range_deg"
    else:
        allowed = name.rpartition("_")[0].partition("_")[0] + (
            "_range_mm" if name.endswith("_mm") else "_range_dpt"
        )
        low, high = getattr(settings, allowed)
    values[name] += change
    if not low <= values[name] <= high:
        raise BadMessage(
            f"differences read {values[name]:.4g}",
            field=name,
            allowed=f"{low:g} to {high:g}, the setting {allowed}",
        )
    return {
        "pupil_diameter_mm": values["pupil_diameter_mm"],
        "focus_dpt": values["focus_dpt"],
        "gaze_deg": (values["gaze_h_deg"], values["gaze_v_deg"]),
    }


def _number(profile: Any, keys: list[str], name: str) -> float:
    for key in keys:
        try:
            profile = profile[int(key) if isinstance(profile, list | tuple) else key]
        except (KeyError, IndexError, ValueError, TypeError):
            raise BadMessage(
                f"{name!r}: there is no {key!r}",
                field="parameters",
                allowed="the path of a number in the profile",
            ) from None
    if isinstance(profile, bool) or not isinstance(profile, int | float):
        raise BadMessage(
            f"{name!r} is {profile!r}", field="parameters", allowed="a number"
        )
    return float(profile)


def _with_number(
    profile: Mapping[str, Any], keys: list[str], value: float
) -> dict[str, Any]:
    found: dict[str, Any] = copy.deepcopy(dict(profile))
    *path, last = keys
    inner: Any = found
    for key in path:
        inner = inner[int(key) if isinstance(inner, list) else key]
    inner[int(last) if isinstance(inner, list) else last] = value
    return found
