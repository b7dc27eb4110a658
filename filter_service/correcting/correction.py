"""`correct`: the picture that a viewer's own eye turns into what was meant.

The scene, or the scene as another eye sees it, is the target.  `nearest_picture` finds
the picture between black and white of a display that comes nearest to it on the
viewer's retina.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter_service.color_encoding import srgb8_of, srgb_curve
from filter_service.correcting.sensitivity import SensitivityWeight
from filter_service.correcting.solver import (
    MAX_ITERATIONS,
    TOLERANCE_LIMITS,
    PictureOperator,
    check_number,
    nearest_picture,
)
from filter_service.errors import BadMessage
from filter_service.filtering.builder import Builder
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.stream_eyes import BuildingEye, EyeEvent
from filter_service.given_profile import Profile
from filter_service.rendering.frame import object_range_dpt
from filter_service.rgbd_view import MIN_DEPTH_M, RgbdView
from filter_service.settings import (
    DEFAULTS,
    MAX_PUPIL_MM,
    MAX_VERGENCE_DPT,
    MIN_PUPIL_MM,
    FilterSettings,
    as_settings,
)
from filter_service.view_state import State
from filter_service.waiting import Wait

Metric = Literal["retina", "sensitivity"]
METRICS: tuple[str, ...] = get_args(Metric)

RANGE_LIMITS = 0.0, 2.0
"""Limits of the ranges of pupils, mm, and of foci, dpt."""

CONTRAST_LIMITS, BRIGHTNESS_LIMITS = (0.01, 1.0), (0.0, 1.0)
MIN_DISTANCE_M = 1.0 / MAX_VERGENCE_DPT

Report = Callable[[float, str], None]


@dataclass(frozen=True)
class Correction:
    """A picture solved for a viewer, and what the viewer sees of it.

    Images are float32, linear light, (height, width, 3).

    Attributes
    ----------
    color
        The picture to display, from 0 (black) to 1 (white).
    target
        The image that the viewer should see.
    before, after
        Images on the retina of the first viewer, in the given state: of the target
        displayed as it is, and of the picture.
    errors : tuple of float
        Mean square differences from the target in the chosen metric, over all viewers
        and states: of the target displayed as it is, and after each iteration.
    lower_bound : float
        Proven lower bound of that error for any picture of this display.
    has_converged : bool
        Whether the solver reached its tolerance within the iterations.
    psnr_before_db, psnr_after_db : float
        Retinal PSNR over all viewers and states, linear light; white is the peak.
    contrast_ratio : float
        Contrast of the target relative to the scene, as given.
    seen_before_ratio, seen_after_ratio : float
        Contrast of the scene that the first viewer sees in the images before and after:
        the slope of the regression of the image on the target at full contrast.
    solve_s : float
        Duration of the solution, without the preparation of the eyes.
    notes : tuple of str
    """

    color: NDArray[np.float32]
    target: NDArray[np.float32]
    before: NDArray[np.float32]
    after: NDArray[np.float32]
    errors: tuple[float, ...]
    lower_bound: float
    has_converged: bool
    psnr_before_db: float
    psnr_after_db: float
    contrast_ratio: float
    seen_before_ratio: float
    seen_after_ratio: float
    solve_s: float
    notes: tuple[str, ...]

    @property
    def color_srgb8(self) -> NDArray[np.uint8]:
        """Return the picture in 8-bit sRGB."""
        return srgb8_of(self.color)

    @property
    def iteration_count(self) -> int:
        """Return the number of iterations."""
        return len(self.errors) - 1

    @property
    def contrast_given_up_ratio(self) -> float:
        """Return the part of the scene's contrast that the target gives up."""
        return 1.0 - self.contrast_ratio


def correct(
    view: RgbdView,
    viewer: Profile | Sequence[Profile],
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    target_eye: Profile | None = None,
    display_distance_m: float | None = None,
    contrast: float = 1.0,
    brightness: float | None = None,
    metric: Metric = "retina",
    pupil_range_mm: float = 0.0,
    focus_range_dpt: float = 0.0,
    tolerance: float = 0.01,
    max_iterations: int = 200,
    settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
    builder: Builder | None = None,
    on_progress: Report | None = None,
) -> Correction:
    """Solve for the picture that a viewer sees as the scene, or as another eye sees it.

    Parameters
    ----------
    view : RgbdView
        The scene: color, depth and camera.
    viewer : profile, or sequence of profiles
        Eye of the viewer; or several eyes, such as left and right, that look at the
        same picture.
    pupil_diameter_mm, focus_dpt : float
        State of the viewers' eyes, and of the target's.
    target_eye : profile, optional
        Eye through which the scene should be seen; by default the target is the scene
        itself.
    display_distance_m : float, optional
        Distance of the display from the viewer, m; by default the picture is displayed
        at the depth of the scene.
    contrast : float, 0.01 to 1
        The target is ``brightness + contrast * (image - mean)``.  A display cannot go
        below black nor above white, so that a target of less contrast can be reached
        more exactly.
    brightness : float, 0 to 1, optional
        Mean of the target, linear light; by default the mean of the image.
    metric : "retina" or "sensitivity"
        Differences on the retina count alike, or by neural contrast sensitivity.
    pupil_range_mm, focus_range_dpt : float, 0 to 2
        Solve for the mean error over the given state, and pupil and focus this much
        larger and smaller.  An error of focus is modeled as one of the distance of the
        display; farther than infinity, as a nearer focus, if the eye can accommodate.
    tolerance : float
        Remaining error at which the solver stops, see `nearest_picture`.
    max_iterations : int
    settings : FilterSettings or mapping, optional
    builder : Builder, optional
        As for `EyeFilter`.
    on_progress : callable, optional
        Called with the completed fraction, 0 to 1, and the stage; otherwise, a bar on
        stderr shows the progress, as for `EyeFilter`.

    Returns
    -------
    Correction

    Raises
    ------
    BadMessage
        If an argument is out of range (a ValueError, too).
    ValueError
        If a profile is invalid.
    SessionError
        If an eye could not be built.
    """
    if not isinstance(view, RgbdView):
        raise BadMessage(
            f"a {type(view).__name__}", field="view", allowed="an RgbdView"
        )
    state = State.checked(pupil_diameter_mm, focus_dpt)
    viewers = _as_profiles(viewer)
    check_choice("metric", metric, METRICS)
    check_number("contrast", contrast, CONTRAST_LIMITS)
    check_number("tolerance", tolerance, TOLERANCE_LIMITS)
    check_number("max_iterations", max_iterations, (1, MAX_ITERATIONS))
    if brightness is not None:
        check_number("brightness", brightness, BRIGHTNESS_LIMITS)
    check_number("pupil_range_mm", pupil_range_mm, RANGE_LIMITS)
    check_number("focus_range_dpt", focus_range_dpt, RANGE_LIMITS)
    if display_distance_m is not None:
        check_number(
            "display_distance_m", display_distance_m, (MIN_DISTANCE_M, math.inf)
        )
    pupils_mm = (pupil_diameter_mm - pupil_range_mm, pupil_diameter_mm + pupil_range_mm)
    if not (pupils_mm[0] >= MIN_PUPIL_MM and pupils_mm[1] <= MAX_PUPIL_MM):
        raise BadMessage(
            f"pupils are {pupils_mm[0]:g} to {pupils_mm[1]:g} mm",
            field="pupil_range_mm",
            allowed=f"pupils of {MIN_PUPIL_MM:g} to {MAX_PUPIL_MM:g} mm",
        )
    displayed = _displayed(view, display_distance_m)
    open_eye = _Opener(
        view=view,
        displayed=displayed,
        settings=as_settings(settings),
        state=state,
        pupil_range_mm=pupil_range_mm,
        focus_range_dpt=focus_range_dpt,
        builder=builder,
        on_progress=on_progress,
    )
    notes: list[str] = []
    image = linear_light(view)
    if target_eye is not None:
        image = open_eye.seen(target_eye, view, notes)
    target = compressed(image, contrast=contrast, brightness=brightness)
    operators = [
        operator
        for profile in viewers
        for operator in open_eye.operators(profile, displayed, notes)
    ]
    weight = SensitivityWeight(view.camera) if metric == "sensitivity" else None
    begin_s = time.perf_counter()
    with Wait("Correcting", is_shown=on_progress is None) as waiting:

        def report(k: int, _: float) -> None:
            waiting.update(k, k / max_iterations, "iterations")
            if on_progress is not None:
                on_progress(k / max_iterations, "iterations")

        solution = nearest_picture(
            operators,
            [target] * len(operators),
            start=target,
            weight=weight,
            tolerance=tolerance,
            max_iterations=max_iterations,
            on_iteration=report,
        )
    solve_s = time.perf_counter() - begin_s
    if on_progress is not None:
        on_progress(1.0, "iterations")
    plain = np.clip(target, np.float32(0.0), np.float32(1.0))
    seen = [[op.forward(x) for op in operators] for x in (plain, solution.color)]
    before_db, after_db = (psnr_db(images, target) for images in seen)
    slopes = [contrast_seen(images[0], image) for images in seen]
    if not solution.has_converged and tolerance > 0.0:
        notes.append(f"not converged after {max_iterations} iterations")
    return Correction(
        color=solution.color,
        target=target,
        before=seen[0][0],
        after=seen[1][0],
        errors=solution.errors,
        lower_bound=solution.lower_bound,
        has_converged=solution.has_converged,
        psnr_before_db=before_db,
        psnr_after_db=after_db,
        contrast_ratio=contrast,
        seen_before_ratio=slopes[0],
        seen_after_ratio=slopes[1],
        solve_s=solve_s,
        notes=tuple(dict.fromkeys(notes)),
    )


def linear_light(view: RgbdView) -> NDArray[np.float32]:
    """Return the color of a view in linear light; non-finite values become 0."""
    if view.color.dtype == np.uint8:
        return srgb_curve(np.asarray(view.color, np.float64) / 255.0).astype(np.float32)
    return np.nan_to_num(view.color.astype(np.float32), posinf=0.0, neginf=0.0)


def compressed(
    image: NDArray[np.float32], *, contrast: float, brightness: float | None
) -> NDArray[np.float32]:
    """Return an image of less contrast about its mean, which moves to a brightness.

    Each channel keeps its own mean, and all move by the same amount.
    """
    means = image.mean(axis=(0, 1), dtype=np.float64)
    shift = 0.0 if brightness is None else brightness - float(means.mean())
    return np.asarray(means + shift + contrast * (image - means), np.float32)


def psnr_db(images: Sequence[NDArray[Any]], target: NDArray[Any]) -> float:
    """Return the PSNR of images over all of their values; the peak is 1."""
    squares = [np.mean((image - target) ** 2, dtype=np.float64) for image in images]
    return float(-10.0 * np.log10(max(float(np.mean(squares)), 1e-30)))


def contrast_seen(image: NDArray[Any], scene: NDArray[Any]) -> float:
    """Return the slope of the regression of an image on a scene, in each channel.

    It is 1 for a scene of one color.
    """
    axes = (0, 1)
    image, scene = (x - x.mean(axis=axes, dtype=np.float64) for x in (image, scene))
    power = float(np.vdot(scene, scene))
    return float(np.vdot(image, scene)) / power if power > 0.0 else 1.0


@dataclass(frozen=True)
class _Opener:
    """Opens eyes for the states of a problem."""

    view: RgbdView
    displayed: RgbdView
    settings: FilterSettings
    state: State
    pupil_range_mm: float
    focus_range_dpt: float
    builder: Builder | None
    on_progress: Report | None

    def _open(self, profile: Profile, stage: str) -> EyeFilter:
        """Open an eye whose settings cover all states and distances."""
        pupil_mm, focus_dpt = self.state.pupil_diameter_mm, self.state.focus_dpt
        reach_dpt = self.focus_range_dpt
        objects_dpt = [
            value
            for view in (self.view, self.displayed)
            for value in object_range_dpt(view)
        ]
        objects_dpt += [d + reach_dpt for d in objects_dpt]
        report = self.on_progress

        def show(event: EyeEvent) -> None:
            if report is not None and isinstance(event, BuildingEye):
                report(event.fraction, f"{stage}, {event.stage}")

        return EyeFilter(
            profile,
            self.view.camera,
            self.settings.covering(
                pupils_mm=(
                    pupil_mm - self.pupil_range_mm,
                    pupil_mm + self.pupil_range_mm,
                ),
                foci_dpt=(
                    focus_dpt,
                    min(focus_dpt + 2.0 * reach_dpt, MAX_VERGENCE_DPT),
                ),
                objects_dpt=tuple(min(d, MAX_VERGENCE_DPT) for d in objects_dpt),
            ),
            on_event=None if report is None else show,
            builder=self.builder,
        )

    def seen(
        self, profile: Profile, view: RgbdView, notes: list[str]
    ) -> NDArray[np.float32]:
        """Return the scene as an eye sees it."""
        with self._open(profile, "target's eye") as eye:
            found = eye.filter(
                view,
                pupil_diameter_mm=self.state.pupil_diameter_mm,
                focus_dpt=self.state.focus_dpt,
                output="linear",
                merge=False,
                bright_pixels=False,  # as in the operators
                whole=True,
            )
        notes.extend(f"target's eye: {note}" for note in found.notes)
        return np.asarray(found.color, np.float32)

    def operators(
        self, profile: Profile, view: RgbdView, notes: list[str]
    ) -> Iterator[PictureOperator]:
        """Yield the operator of the given state, and those of the range about it."""
        with ExitStack() as closing:
            eye = closing.enter_context(self._open(profile, "viewer's eye"))
            seen = eye.filter(
                view,
                pupil_diameter_mm=self.state.pupil_diameter_mm,
                focus_dpt=self.state.focus_dpt,
                whole=True,
            )
            notes.extend(f"viewer's eye: {note}" for note in seen.notes)
            for state, depth_m in self._states(seen.focus_dpt, view.depth_m):
                yield eye.operator(
                    replace(view, depth_m=depth_m),
                    pupil_diameter_mm=state.pupil_diameter_mm,
                    focus_dpt=state.focus_dpt,
                )

    def _states(
        self, reached_dpt: float, depth_m: NDArray[np.float32]
    ) -> Iterator[tuple[State, NDArray[np.float32]]]:
        """Yield states and depths: the given ones, and those of the range.

        A relaxed eye cannot focus farther, so an error of its focus is one of the
        distance of the display: nearer by the range; and farther, or where the display
        is too far for that, a nearer focus than the one that the eye reaches.
        """
        yield self.state, depth_m
        if self.pupil_range_mm > 0.0:
            for sign in (-1.0, 1.0):
                pupil_mm = self.state.pupil_diameter_mm + sign * self.pupil_range_mm
                yield replace(self.state, pupil_diameter_mm=pupil_mm), depth_m
        error_dpt = self.focus_range_dpt
        if error_dpt > 0.0:
            yield self.state, _moved(depth_m, error_dpt)
            known_m = depth_m[depth_m >= MIN_DEPTH_M]
            if not known_m.size or 1.0 / float(known_m.max()) < error_dpt:
                focus_dpt = min(reached_dpt + error_dpt, MAX_VERGENCE_DPT)
                yield replace(self.state, focus_dpt=focus_dpt), depth_m
            else:
                yield self.state, _moved(depth_m, -error_dpt)


def _moved(depth_m: NDArray[np.float32], by_dpt: float) -> NDArray[np.float32]:
    """Return depth with its vergence changed; missing depth stays missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        moved_m = 1.0 / np.maximum(1.0 / depth_m + by_dpt, 0.0)
        return np.where(depth_m >= MIN_DEPTH_M, moved_m, depth_m).astype(np.float32)


def _displayed(view: RgbdView, display_distance_m: float | None) -> RgbdView:
    """Return the view that the viewers see: one surface, at the display's distance."""
    plain = replace(view, hidden_color=None, hidden_depth_m=None)
    if display_distance_m is None:
        return plain
    return replace(plain, depth_m=np.full_like(view.depth_m, display_distance_m))


def _as_profiles(viewer: Profile | Sequence[Profile]) -> tuple[Profile, ...]:
    if isinstance(viewer, str) or not isinstance(viewer, Sequence):
        return (viewer,)
    if not viewer:
        raise BadMessage("it is empty", field="viewer", allowed="one profile or more")
    return tuple(viewer)


def check_choice(field: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise BadMessage unless a value is one of the allowed ones."""
    if value not in allowed:
        raise BadMessage(
            f"it is {value!r:.60}", field=field, allowed=" or ".join(allowed)
        )
