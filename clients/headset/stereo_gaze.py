"""Model of a viewer's two eyes: gaze, focus and pupils for each stereo frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import (
    DueFrame,
    Eye,
    EyeView,
    Image,
    angles_of,
    direction_of,
    matrix_of,
)
from clients.natural_eye import (
    MAX_VERGENCE_DPT,
    USUAL_WHITE_CD_M2,
    NaturalEye,
    field_area_deg2,
    luminance_cd_m2,
    planar_depth_at,
    state_of,
)
from estimator.dynamics import GazeFollower
from filter_service.messages import Camera, State

if TYPE_CHECKING:
    import moderngl

    from clients.scenes.scene_view import SceneImage

Array = NDArray[np.float64]

STRAIGHT_AHEAD = (0.0, 0.0)
FAR_M = 1e6
"""Both eyes see points at this distance or farther in the same direction."""

_N_STEPS = 3
_SAME_RATIO = 1e-3


@dataclass(frozen=True)
class RgbdPicture:
    """Unfiltered image of one eye.

    Attributes
    ----------
    view : EyeView
        View that the image was rendered for.
    color : (h, w, 3) uint8 or float16
        sRGB, or linear light.
    depth_m : (h, w) float32
        Planar depth.
    """

    view: EyeView
    color: NDArray[np.uint8] | NDArray[np.float16]
    depth_m: NDArray[np.float32]

    @property
    def camera(self) -> Camera:
        """Return the camera of the image."""
        height_px, width_px = self.depth_m.shape
        return Camera(width_px, height_px, self.view.tangents)


class TexturePicture:
    """Unfiltered image of one eye in textures, which are read only if necessary.

    Parameters
    ----------
    view : EyeView
        View that the image was rendered for.
    image : SceneImage
        Color, sRGB, and planar depth.
    """

    def __init__(self, view: EyeView, image: SceneImage) -> None:
        self.view, self.image = view, image

    @cached_property
    def _arrays(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        return self.image.read()

    @property
    def color(self) -> NDArray[np.uint8]:
        """Return the color (h, w, 3), sRGB; the first call waits for the GPU."""
        return self._arrays[0]

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """Return the planar depth (h, w); the first call waits for the GPU."""
        return self._arrays[1]

    @property
    def camera(self) -> Camera:
        """Return the camera of the image."""
        width_px, height_px = self.image.color.size
        return Camera(width_px, height_px, self.view.tangents)


Picture = RgbdPicture | TexturePicture
"""Image of one eye, in arrays or in textures."""


def images_of(
    picture: Picture,
) -> tuple[Image, NDArray[np.float32] | moderngl.Texture]:
    """Return color and depth of a picture, as arrays or textures."""
    if isinstance(picture, TexturePicture):
        return picture.image.color, picture.image.depth_m
    return picture.color, picture.depth_m


@dataclass(frozen=True)
class EyeAndGaze:
    """State and gaze of one eye.

    Attributes
    ----------
    state : State
        Pupil and focus.
    gaze_deg : (h, v)
        Gaze direction in the eye's image.
    ahead_deg : (h, v)
        Direction straight ahead of the head in the eye's image, which differs from the
        image center if displays are canted.
    """

    state: State
    gaze_deg: tuple[float, float]
    ahead_deg: tuple[float, float] = STRAIGHT_AHEAD


class StereoGaze:
    """Model of two eyes with equal pupils, and with equal focus if both can reach it.

    Parameters
    ----------
    age_years, pupil_diameter_mm
        As in `NaturalEye`.
    white_cd_m2 : float
        Luminance of the display's white.
    gaze_range_deg : (h, v)
        Largest gaze angles in the images; the gaze is clamped to them.
    focus_dpt : float, optional
        Fixed focus; by default, focus follows the distance of the point of fixation.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    def __init__(
        self,
        *,
        age_years: float,
        pupil_diameter_mm: float | None = None,
        white_cd_m2: float = USUAL_WHITE_CD_M2,
        gaze_range_deg: tuple[float, float] = STRAIGHT_AHEAD,
        focus_dpt: float | None = None,
    ) -> None:
        if focus_dpt is not None and not 0.0 <= focus_dpt <= MAX_VERGENCE_DPT:
            raise ValueError(
                f"focus_dpt is {focus_dpt}; allowed: 0 to {MAX_VERGENCE_DPT:g}"
            )
        if not 0.0 < white_cd_m2 <= 1e5:
            raise ValueError(
                f"white_cd_m2 is {white_cd_m2}; allowed: above 0, up to 100000"
            )
        # Raises for invalid values before anything expensive starts.
        NaturalEye(age_years=age_years, pupil_diameter_mm=pupil_diameter_mm)
        self._age_years, self._pupil_mm = age_years, pupil_diameter_mm
        self._white_cd_m2 = white_cd_m2
        self.gaze_range_deg = gaze_range_deg
        self._focus_dpt = focus_dpt
        self._follower = GazeFollower()
        self._eyes: dict[Eye, NaturalEye] = {}
        self._distance_m: float | None = None
        self.is_tracked = False

    def follow(
        self,
        due: DueFrame,
        pictures: Sequence[Picture],
        known: Sequence[Picture] | None = None,
    ) -> tuple[EyeAndGaze, ...]:
        """Return the state of both eyes at the time when the images are shown.

        Parameters
        ----------
        due : DueFrame
        pictures : sequence of RgbdPicture or TexturePicture
            Images of the frame.
        known : sequence of RgbdPicture or TexturePicture, optional
            Images that provide luminance and depth, such as smaller images of the
            previous frame; by default ``pictures``.
        """
        known = pictures if known is None else known
        at_s = due.now_s
        if due.gaze is not None:
            seen = due.gaze
            self._follower.see(seen.h_deg, seen.v_deg, seen.at_s)
        gaze = self._follower.at(at_s)
        self.is_tracked = gaze.is_tracked
        head = _head(due, pictures)
        direction = head[:3, :3] @ direction_of(gaze.h_deg, gaze.v_deg)
        distance_m = self._distance(head[:3, 3], direction, known)
        # Both pupils follow the mean luminance; both lenses get the same command.
        light_cd_m2 = float(
            np.mean([luminance_cd_m2(p.color, self._white_cd_m2) for p in known])
        )
        found = []
        for picture in pictures:
            eye = self._eye(picture)
            state = eye.look(light_cd_m2, 1.0 / distance_m, at_s)
            if self._focus_dpt is not None:
                state = State(state.pupil_diameter_mm, self._focus_dpt)
            if due.pupil_diameter_mm is not None:
                state = state_of(due.pupil_diameter_mm, state.focus_dpt)
            point = head[:3, 3] + min(distance_m, FAR_M) * direction
            own = matrix_of(picture.view.pose)
            gaze_deg = angles_of(own[:3, :3].T @ (point - own[:3, 3]))
            ahead_deg = _rounded(angles_of(own[:3, :3].T @ -head[:3, 2]))
            gaze_deg = self._clamped(gaze_deg, ahead_deg)
            found.append(EyeAndGaze(state, gaze_deg, ahead_deg))
        return tuple(found)

    def restart(self) -> None:
        """Reset all state: a new runtime may restart its clock."""
        self._follower = GazeFollower()
        self._eyes = {}
        self._distance_m = None
        self.is_tracked = False

    def learn(
        self,
        pictures: Sequence[Picture],
        asked: Sequence[EyeAndGaze],
        used_dpt: Sequence[float | None],
    ) -> None:
        """Learn the far and near points from the foci that the filter used.

        Parameters
        ----------
        pictures : sequence of RgbdPicture or TexturePicture
            Images of a frame.
        asked : sequence of EyeAndGaze
            Requested state of each eye.
        used_dpt : sequence of float or None
            Focus of each eye; None is ignored.
        """
        for picture, eye, found_dpt in zip(pictures, asked, used_dpt, strict=True):
            if found_dpt is not None and picture.view.eye in self._eyes:
                self._eyes[picture.view.eye].learn(eye.state.focus_dpt, found_dpt)

    def change(self, eye: Eye) -> None:
        """Forget the far and near point of an eye that is replaced."""
        if eye in self._eyes:
            self._eyes[eye].change()

    def _eye(self, picture: Picture) -> NaturalEye:
        eye = picture.view.eye
        if eye not in self._eyes:
            self._eyes[eye] = NaturalEye(
                age_years=self._age_years,
                field_area_deg2=field_area_deg2(picture.camera),
                pupil_diameter_mm=self._pupil_mm,
            )
        return self._eyes[eye]

    def _distance(
        self, origin: Array, direction: Array, pictures: Sequence[Picture]
    ) -> float:
        """Return the distance from the midpoint of the eyes to the point of fixation.

        Without depth there, return the previous distance, or infinity if there is
        none.
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


def _along(
    origin: Array, direction: Array, picture: Picture, distance_m: float
) -> float | None:
    """Return the distance at which a ray meets a visible surface; None without depth.

    The ray does not start at the eye of the image.  The distance is found by iteration:
    the point at the current distance is projected into the image, and the depth there
    gives the next distance.
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


def _head(due: DueFrame, pictures: Sequence[Picture]) -> Array:
    """Return the matrix of the head, or of the eyes' mean pose if it is unknown."""
    if due.head is not None:
        return matrix_of(due.head)
    poses = np.array([picture.view.pose for picture in pictures])
    # The quaternions q and -q are the same rotation.
    signs = np.sign(poses[:, 3:] @ poses[0, 3:])
    poses[:, 3:] *= np.where(signs == 0.0, 1.0, signs)[:, None]
    between = poses.mean(axis=0)
    between[3:] /= np.linalg.norm(between[3:])
    return matrix_of(tuple(between.tolist()))


def _rounded(angles_deg: tuple[float, float]) -> tuple[float, float]:
    """Round angles: noise must not cause PSFs to be prepared again."""
    h, v = (round(angle_deg, 2) + 0.0 for angle_deg in angles_deg)
    return h, v
