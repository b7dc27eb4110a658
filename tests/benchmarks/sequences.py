"""Paths of 120 frames, their exact pictures, and how errors change along them."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.grid import GridSpec
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.view_sources import EyeState
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import scene_views

SIZE = {"width_px": 320, "height_px": 180}
FRAME_COUNT = 120

PUPIL_RANGE_MM = (2.5, 6.5)
FOCUS_RANGE_DPT = (0.0, 4.0)
OBJECT_RANGE_DPT = (0.0, 4.0)
GAZE_RANGE_DEG = (10.0, 5.0)
PUPIL_MM, FOCUS_DPT = 5.0, 0.5

CAMERA_PATH = (
    ((0.02, 1.16, 0.02), (-0.50, 0.98, -4.0), PUPIL_MM, 2.0),
    ((0.10, 1.17, -0.20), (0.10, 0.93, -4.0), PUPIL_MM, 2.0),
    ((0.02, 1.19, -0.40), (0.40, 0.99, -4.0), PUPIL_MM, 2.0),
)
"""Forward by 0.4 m, and over *Courtyard* from left to right."""

WINDOWS = ((slice(64, 104), slice(150, 190)), (slice(112, 152), slice(256, 296)))
"""Rows and columns that are compared off the axis: every pixel's own PSF for the whole
frame would take an hour a path."""

HALO_PX = 14
"""Sources around a window that may reach it."""

VISIBLE_RMS = 1e-3
"""Change in parts of white, a quarter of an 8-bit step at mid-grey, below which nobody
could see a jump."""

NEIGHBOURS = 4
"""Frames to both sides that a jump is compared with."""


@dataclass(frozen=True)
class Moment:
    """One frame of a path."""

    view: RgbdView
    pupil_mm: float = PUPIL_MM
    focus_dpt: float = FOCUS_DPT
    gaze_deg: tuple[float, float] = (0.0, 0.0)


@cache
def path(motion: str, first: int = 0, end: int = FRAME_COUNT) -> tuple[Moment, ...]:
    """Frames of a path of `FRAME_COUNT`; "camera", "pupil", "focus", "gaze", "static".

    Parameters
    ----------
    first, end : int
        Which part of it.
    """
    if motion == "camera":
        views = scene_views(
            "courtyard",
            **SIZE,
            count=FRAME_COUNT,
            path=CAMERA_PATH,
            first=first,
            end=end,
        )
        return tuple(Moment(view) for view in views)
    (view,) = scene_views("courtyard", **SIZE, count=5, first=2, end=3)
    moments = []
    for t in np.linspace(0.0, 1.0, FRAME_COUNT)[first:end]:
        turn = (2.0 * t - 1.0) * np.array(GAZE_RANGE_DEG)
        moving = {
            "pupil": {"pupil_mm": _between(PUPIL_RANGE_MM, t)},
            "focus": {"focus_dpt": _between(FOCUS_RANGE_DPT, t)},
            "gaze": {"gaze_deg": (float(turn[0]), float(turn[1]))},
            "static": {},
        }
        moments.append(Moment(view, **moving[motion]))
    return tuple(moments)


def _between(ends: tuple[float, float], share: float) -> float:
    return float(ends[0] + (ends[1] - ends[0]) * share)


def eye_spec(view: RgbdView, mode: str, **settings) -> GridSpec:
    """Spec for everything that paths but the gaze's ask for."""
    settings = {
        "pupil_range_mm": PUPIL_RANGE_MM,
        "focus_range_dpt": FOCUS_RANGE_DPT,
        **settings,
    }
    return grid_spec(
        width_px=view.width_px,
        height_px=view.height_px,
        tangents=view.tangents,
        object_range_dpt=OBJECT_RANGE_DPT,
        mode=mode,
        **settings,
    )


def truth(eye: str, moment: Moment, mode: str) -> list[NDArray[np.float64]]:
    """Exact pictures of the parts that are compared (`compared`)."""
    if mode == "on-axis":
        return [dense_reference(moment.view, exact_state(eye, moment, mode), bins=True)]
    pictures = []
    for window in WINDOWS:
        part, inner = cropped(moment.view, window)
        state = exact_state(eye, replace(moment, view=part), mode)
        pictures.append(dense_reference(part, state, bins=False)[inner])
    return pictures


def compared(picture: NDArray, mode: str) -> list[NDArray[np.float64]]:
    """Parts of a frame that `truth` gives."""
    picture = picture.astype(np.float64)
    if mode == "on-axis":
        return [picture]
    return [picture[window] for window in WINDOWS]


def exact_state(eye: str, moment: Moment, mode: str) -> EyeState:
    spec = eye_spec(
        moment.view,
        "on-axis" if mode == "on-axis" else "quality",
        pupil_range_mm=(moment.pupil_mm,) * 2,
        focus_range_dpt=(moment.focus_dpt,) * 2,
        gaze_deg=moment.gaze_deg,
    )
    return EyeState(traced_eye(eye, spec), spec, moment.pupil_mm, moment.focus_dpt)


def cropped(view: RgbdView, window: tuple[slice, slice]) -> tuple[RgbdView, tuple]:
    """A window with its halo as a view of its own, and the window within it."""
    sizes = (view.height_px, view.width_px)
    rows, columns = (
        slice(max(part.start - HALO_PX, 0), min(part.stop + HALO_PX, size))
        for part, size in zip(window, sizes, strict=True)
    )
    left, right, up, down = view.tangents
    per_column, per_row = (right - left) / view.width_px, (down - up) / view.height_px
    part = replace(
        view,
        color=np.ascontiguousarray(view.color[rows, columns]),
        depth_m=np.ascontiguousarray(view.depth_m[rows, columns]),
        tangents=(
            left + columns.start * per_column,
            left + columns.stop * per_column,
            up + rows.start * per_row,
            up + rows.stop * per_row,
        ),
    )
    inner = tuple(
        slice(own.start - wide.start, own.stop - wide.start)
        for own, wide in zip(window, (rows, columns), strict=True)
    )
    return part, inner


@dataclass(frozen=True)
class Flicker:
    """How the error of a path changes from frame to frame, in light of white = 1.

    Attributes
    ----------
    step_rms : (n - 1,)
        RMS over pixels and channels of the change of the error.
    step_999 : (n - 1,)
        Its 99.9th percentile over pixels, largest channel.
    error_rms : (n,)
        Of the error itself.
    """

    step_rms: NDArray[np.float64]
    step_999: NDArray[np.float64]
    error_rms: NDArray[np.float64]

    @property
    def flicker_db(self) -> float:
        """Largest change over the path, as -20 log10."""
        return decibels(self.step_rms.max())

    @property
    def error_db(self) -> float:
        """PSNR of the worst frame."""
        return decibels(self.error_rms.max())

    def jumps(self, least_rms: float = 1e-9) -> NDArray[np.float64]:
        """Each change over the median of its neighbours' (n - 1,).

        Parameters
        ----------
        least_rms : float
            Smaller medians count as this.
        """
        ratios = np.ones(self.step_rms.size)
        for t, step in enumerate(self.step_rms):
            around = np.r_[max(t - NEIGHBOURS, 0) : t, t + 1 : t + NEIGHBOURS + 1]
            around = around[around < self.step_rms.size]
            if around.size:
                usual = max(float(np.median(self.step_rms[around])), least_rms)
                ratios[t] = step / usual
        return ratios

    @property
    def popping_ratio(self) -> float:
        """Largest jump among changes that could be seen."""
        return float(self.jumps(VISIBLE_RMS).max())


def decibels(rms: float) -> float:
    """RMS in parts of white as dB below it."""
    return float(-20.0 * np.log10(max(rms, 1e-15)))


def flicker(errors: list[list[NDArray[np.float64]]]) -> Flicker:
    """Measure a path's errors: frames of parts (h, w, 3)."""
    flat = [np.concatenate([part.reshape(-1, 3) for part in frame]) for frame in errors]
    steps = [after - before for before, after in pairwise(flat)]
    return Flicker(
        step_rms=np.array([np.sqrt(np.mean(step**2)) for step in steps]),
        step_999=np.array(
            [np.percentile(np.abs(step).max(axis=1), 99.9) for step in steps]
        ),
        error_rms=np.array([np.sqrt(np.mean(error**2)) for error in flat]),
    )
