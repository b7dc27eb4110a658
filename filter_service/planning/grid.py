"""Where the PSF cache has its nodes, and where a frame has its layers.

The cache is spanned by pupil and *total defocus* (refraction + object vergence -
accommodation + chromatic shift): object distance, focus and wavelength act on an
on-axis PSF through that sum alone, so a node serves every combination that shares it.
Frame layers follow the paper, as far as they must: never more than a step of blur apart
(section 6.2, Eq. 8), and where the blur stays, farther than its uniform distances.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from filter_service.camera import Camera, is_same_camera
from filter_service.displays import display_wavelengths_nm, display_widths_nm
from filter_service.errors import BadMessage
from filter_service.planning.field_directions import (
    MAX_FIELD_DEG,
    field_range_deg,
    nearest_inside_deg,
    pixel_from_mrad,
)
from filter_service.settings import DEFAULTS, PLANE_ROOM_DPT, FilterSettings

GREEN = 1
"""Channel that the others are compared with, and that lateral colour leaves."""

PUPIL_RATIO = 1.16
"""Neighbouring pupil nodes differ by at most this factor (tests/benchmarks)."""

MIN_BLUR_STEP_PX = 0.25
BLUR_STEP_RATIO = 0.1
LARGE_BLUR_STEP_RATIO = 0.025
"""Blur step between nodes: a tenth of the blur radius, at least 0.25 px and at most
`GridSpec.max_blur_step_px`, but never finer than 2.5 % of the radius, because a wide
kernel shows a change of its radius in proportion only."""

BASE_OBJECT_STEP_DPT = 0.25
"""The paper's object distances: 33 over 8 dpt."""

FOCUS_LADDER = 65
"""Places between two foci at which the step to the next node is looked at."""

LAYER_BLUR_RATIO = {"on-axis": 0.05, "quality": 0.05, "dynamic": 0.1}
"""Step of blur from layer to layer, of the blur radius; at least `MIN_BLUR_STEP_PX`."""

LAYER_GAP_STEPS = 2.0
"""Most defocus from layer to layer, in steps of what it would blur a perfect eye; at
least `BASE_OBJECT_STEP_DPT`.  With 2.5 % and 0.25 dpt a cataract eye has 198 layers at
1280x720, here 32 and the same error."""

PAPER_REACH_DEG = {"quality": (45.0, 25.0), "dynamic": (45.0, 24.0)}
"""Azimuth and elevation to both sides (released code)."""


@dataclass(frozen=True)
class GridSpec:
    """What a PSF cache is built for.

    Attributes
    ----------
    camera : Camera
        Image size and tangents; the on-axis mode uses no more than its pixel pitch.
    settings : FilterSettings
        Pupils, distances, field, and how fine.
    memory_budget_mb : float
        A larger plan is refused.
    max_blur_step_px : float
        Blur difference between neighbouring nodes.
    max_blur_radius_px : int
        More blur than this is refused; diffraction's tail ends there.
    kept_energy_ratio : float
        Light within a kernel's box; the rest is spread over it again.  0.99 keeps
        filtered images at 60 dB or more of the uncut kernel's, 0.995 at 65 dB, 0.998
        at 67 dB (240 kernels over the field, 2.5 to 6 mm).

    Raises
    ------
    BadMessage
        Pixels too small or too large, or a gaze that turns the image out of all PSFs.
    """

    camera: Camera
    settings: FilterSettings = DEFAULTS
    memory_budget_mb: float = 2000.0
    max_blur_step_px: float = 0.5
    max_blur_radius_px: int = 255
    kept_energy_ratio: float = 0.99

    def __post_init__(self) -> None:
        """Refuse what no cache can be built for."""
        for pitch_mrad in self.pixel_pitch_mrad:
            if not 0.005 <= pitch_mrad <= 100.0:
                raise BadMessage(
                    f"its pixels are {pitch_mrad:.3g} mrad wide",
                    field="camera",
                    allowed="0.005 to 100 mrad for a pixel on the axis",
                )
        self._check_gaze()

    def _check_gaze(self) -> None:
        """Refuse a gaze that turns the image out of all PSFs."""
        if not (self.follows_field and any(self.settings.gaze_range_deg)):
            return
        seen_deg = field_range_deg(self.camera, gaze_deg=self.settings.gaze_deg)
        turns_deg = self.settings.gaze_range_deg
        for (low, high), turn in zip(seen_deg, turns_deg, strict=True):
            if turn > 0.0 and max(-low, high) + turn > MAX_FIELD_DEG:
                raise BadMessage(
                    f"{turn:g} beside a field of {low:.3g} to {high:.3g} deg",
                    field="settings.gaze_range_deg",
                    allowed=f"{MAX_FIELD_DEG:g} together",
                )

    def with_settings(self, **changes: Any) -> "GridSpec":
        """Return the spec with some settings changed."""
        return replace(self, settings=self.settings.changed(**changes))

    @property
    def pixel_pitch_mrad(self) -> tuple[float, float]:
        """Width and height of the pixel on the camera's axis."""
        return self.camera.pixel_pitch_mrad

    def serves(self, camera: Camera) -> bool:
        """Return whether PSFs for this spec serve a camera."""
        return is_same_camera(self.camera, camera, follows_field=self.follows_field)

    @property
    def follows_field(self) -> bool:
        """Whether PSFs differ over the visual field."""
        return self.settings.follows_field

    @property
    def field_range_deg(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Field directions (h, v) from smallest to largest that PSFs are needed for."""
        if not self.follows_field:
            return (0.0, 0.0), (0.0, 0.0)
        ranges = [
            field_range_deg(self.camera, gaze_deg=gaze_deg)
            for gaze_deg in self.gaze_samples_deg()
        ]
        seen_deg = tuple(
            (min(r[axis][0] for r in ranges), max(r[axis][1] for r in ranges))
            for axis in range(2)
        )
        if self.settings.grid == "planned":
            return seen_deg
        return tuple(
            (min(low, -reach), max(high, reach))
            for (low, high), reach in zip(
                seen_deg, PAPER_REACH_DEG[self.settings.mode], strict=True
            )
        )

    @property
    def blends_at_equal_blur(self) -> bool:
        """Whether field nodes are blended at equal defocus, not at equal distance.

        Nodes that the planner chose hold the defocus that their neighbours read; the
        paper's hold nine object distances of their own.
        """
        return self.settings.grid == "planned"

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Wavelengths of red, green and blue."""
        return display_wavelengths_nm(self.settings.display)

    @property
    def channel_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (3,) of the channels; all the same without chromatic blur."""
        if not self.settings.chromatic:
            return np.full(len(self.wavelengths_nm), REFERENCE_WAVELENGTH_NM)
        return np.array(self.wavelengths_nm)

    @property
    def primary_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (n, 3) whose PSFs, averaged, are those of the channels."""
        middle_nm = self.channel_wavelengths_nm
        if not (self.settings.chromatic and self.settings.wide_primaries):
            return middle_nm[None]
        widths_nm = np.array(display_widths_nm(self.settings.display))
        return np.stack([middle_nm - widths_nm, middle_nm + widths_nm])

    @property
    def traced_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (n,) at which the eye must be known, ascending."""
        every = (self.channel_wavelengths_nm, self.primary_wavelengths_nm.ravel())
        return np.unique(np.concatenate(every))

    def blur_px_per_dpt(self, pupil_diameter_mm: float) -> float:
        """Radius of the geometric blur disc on axis per dioptre of defocus, px."""
        return pupil_diameter_mm / 2.0 / min(self.pixel_pitch_mrad)

    @property
    def object_ranges_dpt(self) -> list[tuple[float, float]]:
        """Where objects are, dpt: one range, or one for each plane.

        Towards the corners of the image a plane is farther than on the axis.
        """
        planes_dpt = self.settings.object_planes_dpt
        if not planes_dpt:
            return [self.settings.object_range_dpt]
        corner_ratio = self.camera.corner_distance_ratio
        return [
            (
                max(plane_dpt - PLANE_ROOM_DPT, 0.0) / corner_ratio,
                plane_dpt + PLANE_ROOM_DPT,
            )
            for plane_dpt in planes_dpt
        ]

    @property
    def object_range_dpt(self) -> tuple[float, float]:
        """Farthest and nearest object, dpt."""
        ranges = self.object_ranges_dpt
        return min(low for low, _ in ranges), max(high for _, high in ranges)

    def gaze_samples_deg(self) -> list[tuple[float, float]]:
        """Directions of gaze over the range: its middle, edges and corners."""
        steps = [
            (-reach, 0.0, reach) if reach > 0.0 else (0.0,)
            for reach in self.settings.gaze_range_deg
        ]
        return [
            (self.settings.gaze_deg[0] + h, self.settings.gaze_deg[1] + v)
            for h in steps[0]
            for v in steps[1]
        ]

    def pixel_from_mrad(
        self, h_deg, v_deg, *, gaze_deg: tuple[float, float] | None = None
    ) -> NDArray[np.float64]:
        """Local scale (..., 2, 2) of the image at field directions; on axis its own."""
        if not self.follows_field:
            axis = np.diag(1.0 / np.array(self.pixel_pitch_mrad))
            return np.broadcast_to(axis, (*np.shape(h_deg), 2, 2))
        gaze_deg = self.settings.gaze_deg if gaze_deg is None else gaze_deg
        return pixel_from_mrad(self.camera, h_deg, v_deg, gaze_deg=gaze_deg)

    def node_pixel_from_mrad(self, h_deg, v_deg) -> NDArray[np.float64]:
        """Scale (..., 2, 2) of the pixels that kernels of a field node are stored in.

        That of the image where the node is seen.  A node that the gaze moves over the
        image has the pixels of its axis, made so much smaller that no place in the
        image has smaller ones: frames then only ever average stored pixels.
        """
        if not any(self.settings.gaze_range_deg) or not self.follows_field:
            return self.pixel_from_mrad(h_deg, v_deg)
        axis = np.diag(1.0 / np.array(self.pixel_pitch_mrad))
        finest = np.ones(np.shape(h_deg))
        for gaze_deg in self.gaze_samples_deg():
            inside = nearest_inside_deg(self.camera, h_deg, v_deg, gaze_deg=gaze_deg)
            local = self.pixel_from_mrad(*inside, gaze_deg=gaze_deg)
            ratio = np.linalg.norm(np.linalg.solve(axis, local), ord=2, axis=(-2, -1))
            finest = np.maximum(finest, ratio)
        return finest[..., None, None] * axis


def blur_step_px(blur_px: float, max_blur_step_px: float) -> float:
    """Return the blur difference allowed to the next node at a blur radius."""
    step_px = min(max(BLUR_STEP_RATIO * blur_px, MIN_BLUR_STEP_PX), max_blur_step_px)
    return max(step_px, LARGE_BLUR_STEP_RATIO * blur_px)


def pupil_nodes_mm(pupil_range_mm: tuple[float, float]) -> NDArray[np.float64]:
    """Pupil diameters of the cache, geometric from end to end of the range."""
    low_mm, high_mm = pupil_range_mm
    if math.isclose(low_mm, high_mm):
        return np.array([high_mm])
    count = 1 + math.ceil(math.log(high_mm / low_mm) / math.log(PUPIL_RATIO))
    return np.geomspace(low_mm, high_mm, count)


def nodes_through_foci_dpt(
    low_dpt: float,
    high_dpt: float,
    *,
    foci_dpt: NDArray[np.float64],
    blur_px_per_dpt: float,
    max_blur_step_px: float,
) -> NDArray[np.float64]:
    """Nodes as those of `defocus_nodes_dpt`, of a lens that is sharp at several.

    Each focus inside the range is a node, and steps are those of the nearest.
    """
    inside = foci_dpt[(foci_dpt > low_dpt) & (foci_dpt < high_dpt)]
    ends = np.unique(np.concatenate([[low_dpt], inside, [high_dpt]]))
    nodes = [ends[:1]]
    for first, last in pairwise(ends.tolist()):
        at_dpt = np.linspace(first, last, FOCUS_LADDER)
        away_dpt = np.abs(at_dpt[:, None] - foci_dpt).min(axis=1)
        step_px = [
            blur_step_px(blur, max_blur_step_px)
            for blur in (away_dpt * blur_px_per_dpt).tolist()
        ]
        density = blur_px_per_dpt / np.array(step_px)
        steps = np.diff(at_dpt) * (density[1:] + density[:-1]) / 2.0
        needed = np.append(0.0, np.cumsum(steps))
        count = max(math.ceil(needed[-1]), 1)
        wanted = np.linspace(0.0, needed[-1], count + 1)[1:]
        nodes.append(np.interp(wanted, needed, at_dpt))
    return np.unique(np.concatenate(nodes))


def defocus_nodes_dpt(
    low_dpt: float, high_dpt: float, *, blur_px_per_dpt: float, max_blur_step_px: float
) -> NDArray[np.float64]:
    """Total defocus of the cache nodes for one pupil, ascending, covering a range.

    Zero is a node whenever it lies inside, so a focused object meets no interpolation.
    """

    def outwards(limit_dpt: float) -> list[float]:
        nodes = [0.0]
        while nodes[-1] < limit_dpt:
            blur_px = nodes[-1] * blur_px_per_dpt
            nodes.append(
                nodes[-1] + blur_step_px(blur_px, max_blur_step_px) / blur_px_per_dpt
            )
        return nodes

    negative = [-t for t in outwards(max(-low_dpt, 0.0))]
    nodes = np.unique(np.array(negative + outwards(max(high_dpt, 0.0))))
    first = max(int(np.searchsorted(nodes, low_dpt, side="right")) - 1, 0)
    last = min(int(np.searchsorted(nodes, high_dpt, side="left")), len(nodes) - 1)
    return nodes[first : last + 1]
