"""Scenes that a lens should make sharp, and the error of their images.

The error is a mean square difference.  A displacement of the whole image, as by prism
or by coma, which a person does not see, is not an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import shift, spline_filter

from estimator.media import LUMINANCE
from filter_service.correcting.sensitivity import SensitivityWeight
from filter_service.correcting.solver import check_number
from filter_service.errors import BadMessage
from filter_service.rendering.frame import (
    fill_missing_depth,
    object_dpt,
    object_range_dpt,
)
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State

LensMeasure = Literal["luminance", "retina", "sensitivity"]
LENS_MEASURES: tuple[str, ...] = get_args(LensMeasure)

MAX_SCENES = 16
WEIGHT_LIMITS = 1e-6, 1e6

MAX_FOCI = 8
FOCUS_STEP_DPT = 0.5
"""Most distances at which an eye focuses in one scene, and their least spacing."""

FLAT_DPT = 0.1
"""Range of distances up to which exact PSFs take no longer than others."""

REGISTRATION_STEPS, SMALLEST_OFFSET_PX = 8, 0.002


@dataclass(frozen=True, kw_only=True)
class LensScene:
    """A scene that a lens should make sharp, and the state in which the eye sees it.

    Attributes
    ----------
    view : RgbdView
        Color, depth and camera.
    pupil_diameter_mm : float
    focus_dpt : float, optional
        Distance of focus; by default, the eye focuses each distance in the scene.
    weight_ratio : float
        Weight of the scene's error in the mean over the scenes.
    gaze_deg : (h, v)
        Direction of the camera's axis relative to the head, where the line of sight
        crosses a progressive lens.
    """

    view: RgbdView
    pupil_diameter_mm: float
    focus_dpt: float | None = None
    weight_ratio: float = 1.0
    gaze_deg: tuple[float, float] = (0.0, 0.0)


class Sight:
    """A scene with its target and the weights of differences."""

    def __init__(self, scene: LensScene, measure: LensMeasure) -> None:
        self.scene = scene
        self.target = np.empty((0, 0, 3), np.float32)
        self.objects_dpt = object_range_dpt(scene.view)
        self.range_dpt = focus_range_dpt(scene)
        far_dpt, near_dpt = self.objects_dpt
        self.is_flat = near_dpt - far_dpt < FLAT_DPT
        self._of_luminance = measure == "luminance"
        has_weight = measure in ("luminance", "sensitivity")
        self._weight = SensitivityWeight(scene.view.camera) if has_weight else None

    def error(self, image: NDArray[np.float32]) -> float:
        """Return the mean square difference from the target, by the measure.

        A displacement of the whole image is not an error.
        """
        weights = np.array(LUMINANCE, np.float32)
        luminance = image @ weights, self.target @ weights
        offset_px = displacement_px(*luminance)
        values, target = image, self.target
        if self._of_luminance:
            values, target = (each[..., None] for each in luminance)
        channels = np.moveaxis(values, 2, 0)
        moved = [shift(channel, offset_px, mode="nearest") for channel in channels]
        difference = np.stack(moved, axis=2) - target
        if self._weight is not None:
            difference = self._weight.forward(difference)
        return float(np.mean(difference**2, dtype=np.float64))

    def foci(self, *, can_focus: bool) -> Iterator[tuple[float, NDArray[np.bool_]]]:
        """Yield distances of focus, the farthest first, and the pixels seen with each.

        Parameters
        ----------
        can_focus : bool
            Whether frames of different foci differ.
        """
        low_dpt, high_dpt = self.range_dpt
        view = self.scene.view
        filled_m, _ = fill_missing_depth(view.depth_m)
        at_dpt = np.clip(object_dpt(view, filled_m), low_dpt, high_dpt)
        step_dpt = max(FOCUS_STEP_DPT, (high_dpt - low_dpt) / (MAX_FOCI - 1))
        levels = np.rint((at_dpt - low_dpt) / step_dpt).astype(int)
        if not can_focus:
            levels[...] = 0
        for level in np.unique(levels).tolist():
            pixels = levels == level
            yield float(at_dpt[pixels].mean()), pixels


def displacement_px(
    image: NDArray[np.float32], target: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the displacement (rows, columns) that brings an image nearest to a target.

    It minimizes the mean square difference of images (height, width) by Newton steps of
    at most 1 px.  Images between pixels are cubic splines.
    """
    coefficients = spline_filter(image, output=np.float32, mode="nearest")
    wanted = np.gradient(target)
    offset_px = np.zeros(2)
    for _ in range(REGISTRATION_STEPS):
        moved = shift(coefficients, offset_px, mode="nearest", prefilter=False)
        slopes = np.gradient(moved)
        # Exact for blurred targets; negative where edges do not overlap.
        curvature = _symmetric_products(slopes, wanted)
        if np.linalg.eigvalsh(curvature)[0] <= 0.0:
            curvature = _symmetric_products(wanted, wanted)
        right = [
            np.vdot((a + b) / 2.0, moved - target)
            for a, b in zip(slopes, wanted, strict=True)
        ]
        step_px = np.linalg.lstsq(curvature, right)[0]
        offset_px += np.clip(step_px, -1.0, 1.0)
        if np.abs(step_px).max() < SMALLEST_OFFSET_PX:
            break
    return offset_px


def _symmetric_products(
    first: Iterable[NDArray[np.float32]], second: Iterable[NDArray[np.float32]]
) -> NDArray[np.float64]:
    """Return the symmetric part of the matrix of inner products."""
    products = np.array([[np.vdot(a, b) for b in second] for a in first], np.float64)
    return (products + products.T) / 2.0


def focus_range_dpt(scene: LensScene) -> tuple[float, float]:
    """Return the farthest and the nearest focus in a scene."""
    if scene.focus_dpt is None:
        return object_range_dpt(scene.view)
    return scene.focus_dpt, scene.focus_dpt


def checked_scenes(scenes: LensScene | Sequence[LensScene]) -> list[LensScene]:
    """Return the scenes as a list.

    Raises
    ------
    BadMessage
        If there are none or too many, or one has a value out of range.
    """
    found = [scenes] if isinstance(scenes, LensScene) else list(scenes)
    if not 1 <= len(found) <= MAX_SCENES:
        raise BadMessage(
            f"there are {len(found)}", field="scenes", allowed=f"1 to {MAX_SCENES}"
        )
    for k, scene in enumerate(found):
        if not isinstance(scene, LensScene):
            raise BadMessage(
                f"a {type(scene).__name__}", field=f"scenes[{k}]", allowed="a LensScene"
            )
        State.checked(scene.pupil_diameter_mm, scene.focus_dpt or 0.0, scene.gaze_deg)
        check_number(f"scenes[{k}].weight_ratio", scene.weight_ratio, WEIGHT_LIMITS)
    return found
