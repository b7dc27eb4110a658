"""What both eyes of a person do with what they are shown: gaze, focus and pupils."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.headset.poses import angles_of, direction_of, matrix_of
from clients.headset.runtime import DueFrame, Eye, EyeView
from clients.natural import (
    USUAL_WHITE_CD_M2,
    EyeState,
    NaturalEye,
    field_area_deg2,
    luminance_cd_m2,
    planar_depth_at,
)
from estimator.dynamics import GazeFollower
from filter_service.messages import Camera

STRAIGHT_AHEAD = (0.0, 0.0)
FAR_M = 1e6
"""What is farther is seen in the same direction by both eyes."""

_N_STEPS = 3
_SAME_RATIO = 1e-3


@dataclass(frozen=True)
class RgbdPicture:
    """What one eye is shown, unfiltered.

    Attributes
    ----------
    view : EyeView
    color : (h, w, 3) uint8 sRGB
    depth_m : (h, w) float32, planar
    """

    view: EyeView
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]

    @property
    def camera(self) -> Camera:
        """Return the camera that has taken it."""
        height_px, width_px = self.depth_m.shape
        return Camera(width_px, height_px, self.view.tangents)


@dataclass(frozen=True)
class LookingEye:
    """One eye in a moment.

    Attributes
    ----------
    state : EyeState
    gaze_deg, ahead_deg : (h, v)
        Where it looks, and straight ahead of the head, in its own picture: displays may
        be canted.
    """

    state: EyeState
    gaze_deg: tuple[float, float]
    ahead_deg: tuple[float, float] = STRAIGHT_AHEAD


class StereoLook:
    """Follows both eyes: the pupils are alike, and both focus alike as far as they can.

    Parameters
    ----------
    age_years, pupil_diameter_mm
        As of `NaturalEye`.
    white_cd_m2 : float
        The display's white.
    gaze_range_deg : (h, v)
        How far eyes turn in their pictures; what is beyond counts as this.
    """

    def __init__(
        self,
        *,
        age_years: float,
        pupil_diameter_mm: float | None = None,
        white_cd_m2: float = USUAL_WHITE_CD_M2,
        gaze_range_deg: tuple[float, float] = STRAIGHT_AHEAD,
    ) -> None:
        if not 0.0 < white_cd_m2 <= 1e5:
            raise ValueError(
                f"white_cd_m2 is {white_cd_m2}; allowed: above 0, to 100000"
            )
        self._age_years, self._pupil_mm = age_years, pupil_diameter_mm
        self._white_cd_m2 = white_cd_m2
        self.gaze_range_deg = gaze_range_deg
        self._follower = GazeFollower()
        self._eyes: dict[Eye, NaturalEye] = {}
        self._distance_m: float | None = None
        self.is_tracked = False

    def follow(
        self, due: DueFrame, pictures: Sequence[RgbdPicture]
    ) -> tuple[LookingEye, ...]:
        """Return both eyes as they are when the pictures are shown."""
        at_s = due.now_s
        if due.gaze is not None:
            seen = due.gaze
            self._follower.see(seen.h_deg, seen.v_deg, seen.at_s)
        gaze = self._follower.at(at_s)
        self.is_tracked = gaze.is_tracked
        head = _head(due, pictures)
        direction = head[:3, :3] @ direction_of(gaze.h_deg, gaze.v_deg)
        distance_m = self._distance(head[:3, 3], direction, pictures)
        # Both pupils follow the light of both eyes, and both lenses one command.
        light_cd_m2 = float(
            np.mean([luminance_cd_m2(p.color, self._white_cd_m2) for p in pictures])
        )
        found = []
        for picture in pictures:
            eye = self._eye(picture)
            state = eye.look(light_cd_m2, 1.0 / distance_m, at_s)
            if due.pupil_diameter_mm is not None:
                state = state.with_pupil(due.pupil_diameter_mm)
            point = head[:3, 3] + min(distance_m, FAR_M) * direction
            own = matrix_of(picture.view.pose)
            gaze_deg = angles_of(own[:3, :3].T @ (point - own[:3, 3]))
            ahead_deg = _rounded(angles_of(own[:3, :3].T @ -head[:3, 2]))
            gaze_deg = self._clamped(gaze_deg, ahead_deg)
            found.append(LookingEye(state, gaze_deg, ahead_deg))
        return tuple(found)

    def restart(self) -> None:
        """Begin anew: a runtime's clock may start again with it."""
        self._follower = GazeFollower()
        self._eyes = {}
        self._distance_m = None
        self.is_tracked = False

    def learn(self, eye: Eye, asked_dpt: float, used_dpt: float) -> None:
        """Take in what the filter made of an eye's focus."""
        if eye in self._eyes:
            self._eyes[eye].learn(asked_dpt, used_dpt)

    def change(self, eye: Eye) -> None:
        """Let an eye become another one."""
        if eye in self._eyes:
            self._eyes[eye].change()

    def _eye(self, picture: RgbdPicture) -> NaturalEye:
        eye = picture.view.eye
        if eye not in self._eyes:
            self._eyes[eye] = NaturalEye(
                age_years=self._age_years,
                field_area_deg2=field_area_deg2(picture.camera),
                pupil_diameter_mm=self._pupil_mm,
            )
        return self._eyes[eye]

    def _distance(self, origin, direction, pictures: Sequence[RgbdPicture]) -> float:
        """Return how far what is looked at is from between the eyes.

        Where nothing has depth, what was looked at last counts, and infinity before.
        """
        before_m = self._distance_m or math.inf
        for picture in reversed(pictures):
            found_m = _along(origin, direction, picture, before_m)
            if found_m is not None:
                self._distance_m = found_m
                return found_m
        return before_m

    def _clamped(
        self, gaze_deg: tuple[float, float], ahead_deg: tuple[float, float]
    ) -> tuple[float, float]:
        h, v = (
            min(max(angle, middle - reach), middle + reach)
            for angle, middle, reach in zip(
                gaze_deg, ahead_deg, self.gaze_range_deg, strict=True
            )
        )
        return h, v


def _along(origin, direction, picture: RgbdPicture, distance_m: float) -> float | None:
    """Return where a ray meets what a picture shows; None where it has no depth.

    The picture is another eye's: from a first guess the point is looked for where the
    ray is seen, until it stays.
    """
    own = matrix_of(picture.view.pose)
    turn = own[:3, :3].T
    begin, ray = turn @ (origin - own[:3, 3]), turn @ direction
    for _ in range(_N_STEPS):
        seen_deg = angles_of(begin + min(distance_m, FAR_M) * ray)
        depth_m = planar_depth_at(picture.depth_m, picture.camera, seen_deg)
        if depth_m is None or not ray[2] < 0.0:
            return None
        before_m, distance_m = distance_m, (depth_m + begin[2]) / -ray[2]
        if distance_m <= 0.0:
            return None
        if distance_m == before_m or abs(distance_m / before_m - 1.0) < _SAME_RATIO:
            break
    return distance_m


def _head(due: DueFrame, pictures: Sequence[RgbdPicture]):
    """Return the head's matrix; between the eyes where the runtime does not say."""
    if due.head is not None:
        return matrix_of(due.head)
    poses = np.array([picture.view.pose for picture in pictures])
    # q and -q are the same turn
    signs = np.sign(poses[:, 3:] @ poses[0, 3:])
    poses[:, 3:] *= np.where(signs == 0.0, 1.0, signs)[:, None]
    between = poses.mean(axis=0)
    between[3:] /= np.linalg.norm(between[3:])
    return matrix_of(tuple(between.tolist()))


def _rounded(angles_deg: tuple[float, float]) -> tuple[float, float]:
    """Return angles without noise: PSFs are prepared for them."""
    h, v = (round(angle_deg, 2) + 0.0 for angle_deg in angles_deg)
    return h, v
