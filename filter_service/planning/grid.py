"""Specification of a PSF cache, and placement of its nodes, layers and directions.

`GridSpec` states what the PSFs of an eye must cover: a camera, settings and limits.
The planner derives the nodes from it, the PSF store computes and caches the PSFs of
these nodes, and the engines select PSFs for a frame by it.

The cache spans pupil and *total defocus* (refraction + object vergence -
accommodation + chromatic shift).  Object distance, focus and wavelength affect an
on-axis PSF only through that sum, so a node serves every combination with the same
sum.  As in the paper (section 6.2, Eq. 8), layers of a frame are at most one step of
blur apart; where the blur is constant, they are farther apart than the uniform
distances of the paper.

The camera is a pinhole in the eye's entrance pupil, and gaze rotates the eye relative
to it.  Field directions (h, v) are relative to the eye (CONVENTIONS.md), so the PSFs of
a field direction move over the image with the gaze.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics import pinhole
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.psf.tables import GEOMETRIC_FROM_DB
from filter_service.camera import Camera, is_same_camera
from filter_service.displays import display_wavelengths_nm, display_widths_nm
from filter_service.errors import BadMessage
from filter_service.settings import DEFAULTS, PLANE_HALF_THICKNESS_DPT, FilterSettings

MAX_FIELD_DEG = 80.0
"""Largest angle from the camera's axis and from the gaze at which there are nodes."""

BORDER_SAMPLES = 33
"""Number of points along each image edge at which the field extent is sampled."""


def unit_direction(h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
    """Return unit vectors (..., 3) to sources at azimuth h and elevation v."""
    h, v = np.radians(np.asarray(h_deg, float)), np.radians(np.asarray(v_deg, float))
    return np.stack(
        [np.sin(h) * np.cos(v), np.sin(v) * np.ones_like(h), -np.cos(h) * np.cos(v)],
        axis=-1,
    )


def angles_deg(direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return azimuths and elevations (...) of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(direction, float), -1, 0)
    return (
        np.degrees(np.arctan2(x, -z)),
        np.degrees(np.arctan2(y, np.hypot(x, z))),
    )


def gaze_rotation(gaze_deg: tuple[float, float]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from eye to camera: up by v, then sideways by h."""
    h, v = np.radians(gaze_deg)
    up = np.array([[1, 0, 0], [0, np.cos(v), -np.sin(v)], [0, np.sin(v), np.cos(v)]])
    aside = np.array([[np.cos(h), 0, -np.sin(h)], [0, 1, 0], [np.sin(h), 0, np.cos(h)]])
    return aside @ up


def field_deg(
    camera: Camera,
    x_px: ArrayLike,
    y_px: ArrayLike,
    *,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the field direction (h, v), deg, of an image point, y downward.

    The center of the top-left pixel is (0.5, 0.5).
    """
    tangent_x, tangent_y = pinhole.tangents_at(
        x_px,
        y_px,
        tangents=camera.tangents,
        size_px=(camera.width_px, camera.height_px),
    )
    direction = np.stack(
        np.broadcast_arrays(tangent_x, tangent_y, -np.ones(())), axis=-1
    )
    return angles_deg(direction @ gaze_rotation(gaze_deg))


def field_range_deg(
    camera: Camera, *, gaze_deg: tuple[float, float] = (0.0, 0.0)
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of h and v in an image, within ±`MAX_FIELD_DEG`."""
    along = np.linspace(0.0, 1.0, BORDER_SAMPLES)
    x, y = np.meshgrid(along * camera.width_px, along * camera.height_px)
    h_deg, v_deg = field_deg(camera, x, y, gaze_deg=gaze_deg)
    return _limits_deg(h_deg), _limits_deg(v_deg)


def _limits_deg(angle_deg: NDArray[np.float64]) -> tuple[float, float]:
    return (
        float(np.clip(angle_deg.min(), -MAX_FIELD_DEG, MAX_FIELD_DEG)),
        float(np.clip(angle_deg.max(), -MAX_FIELD_DEG, MAX_FIELD_DEG)),
    )


def nearest_inside_deg(
    camera: Camera,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    gaze_deg: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return field directions (h, v), clamped to the image."""
    turn = gaze_rotation(gaze_deg)
    x, y, z = np.moveaxis(unit_direction(h_deg, v_deg) @ turn.T, -1, 0)
    left, right, up, down = camera.tangents
    ahead = np.maximum(-z, np.cos(np.radians(MAX_FIELD_DEG)))
    seen = np.stack(
        [
            np.clip(x / ahead, left, right),
            np.clip(y / ahead, down, up),
            -np.ones_like(x),
        ],
        axis=-1,
    )
    return angles_deg(seen @ turn)


def pixel_from_mrad(
    camera: Camera,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float64]:
    """Return the local scale (..., 2, 2) of the image at a field direction.

    The scale is in pixels (x right, y up) per mrad along the pupil axes (ex, ey) of
    that field; see `pinhole.pixel_from_mrad`.  Directions beyond the camera's
    ±`MAX_FIELD_DEG` are clamped to it.
    """
    turn = gaze_rotation(gaze_deg)
    direction = unit_direction(h_deg, v_deg)
    camera_h, camera_v = angles_deg(direction @ turn.T)
    scale = pinhole.pixel_from_mrad(
        np.clip(camera_h, -MAX_FIELD_DEG, MAX_FIELD_DEG),
        np.clip(camera_v, -MAX_FIELD_DEG, MAX_FIELD_DEG),
        tangents=camera.tangents,
        size_px=(camera.width_px, camera.height_px),
    )
    # The eye's pupil axes, rotated into the camera's frame, relative to the camera's.
    eye_axes = np.stack(_pupil_axes(direction), axis=-1)  # (..., 3, 2)
    camera_axes = np.stack(_pupil_axes(direction @ turn.T), axis=-1)
    roll = np.swapaxes(camera_axes, -1, -2) @ (turn @ eye_axes)
    return scale @ roll


def _pupil_axes(direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return ex = u x y, normalized, and ey = ex x u, each (..., 3)."""
    ex = np.cross(direction, np.array([0.0, 1.0, 0.0]))
    ex /= np.linalg.norm(ex, axis=-1, keepdims=True)
    return ex, np.cross(ex, direction)


GREEN = 1
"""Reference channel, which lateral color does not shift."""

PUPIL_RATIO = 1.16
"""Largest ratio of neighboring pupil nodes (tests/benchmarks)."""

MIN_BLUR_STEP_PX = 0.25
BLUR_STEP_RATIO = 0.1
LARGE_BLUR_STEP_RATIO = 0.025
"""Blur step between nodes: a tenth of the blur radius, at least 0.25 px and at most
`GridSpec.max_blur_step_px`, but never less than 2.5 % of the radius, because in a wide
kernel only the relative change of the radius is visible."""

BASE_OBJECT_STEP_DPT = 0.25
"""Step of the paper's object distances: 33 over 8 dpt."""

FOCUS_SAMPLES = 65
"""Number of positions between two foci at which the step is evaluated."""

LAYER_BLUR_RATIO = {"on-axis": 0.05, "quality": 0.05, "dynamic": 0.1}
"""Blur step between layers relative to the blur radius, by mode; the step is at least
`MIN_BLUR_STEP_PX`."""

LAYER_GAP_STEPS = 2.0
"""Largest defocus between layers, in blur steps of a perfect eye; at least
`BASE_OBJECT_STEP_DPT`.  With 2.5 % and 0.25 dpt, a cataract eye has 198 layers at
1280x720; with these values, 32 and the same error."""

PAPER_REACH_DEG = {"quality": (45.0, 25.0), "dynamic": (45.0, 24.0)}
"""Azimuth and elevation of the field to either side, in the paper's released code."""


@dataclass(frozen=True)
class GridSpec:
    """Specification of a PSF cache.

    Attributes
    ----------
    camera : Camera
        Image size and tangents; the on-axis mode uses only its pixel pitch.
    settings : FilterSettings
        Pupils, distances, field and tolerance.
    memory_budget_mb : float
        Maximum memory of a plan.
    max_blur_step_px : float
        Blur difference between neighboring nodes.
    max_blur_radius_px : int
        Maximum blur radius, at which diffraction tails are cut off.
    kept_energy_ratio : float
        Share of light within a kernel's box; kernels are normalized to unit sum
        afterward.  With 0.99, filtered images have a PSNR of 60 dB or more against
        uncropped kernels, with 0.995 65 dB, with 0.998 67 dB (240 kernels over the
        field, 2.5 to 6 mm).
    rays_from_db : float
        Predicted PSNR from which PSFs are computed by ray optics.
    is_exact : bool
        Whether the PSFs are those of a single state, for frames with a render tolerance
        of 0; see `psfs.exact_store`.

    Raises
    ------
    BadMessage
        If pixels are too small or too large, or the range of gaze exceeds the field.
    """

    camera: Camera
    settings: FilterSettings = DEFAULTS
    memory_budget_mb: float = 2000.0
    max_blur_step_px: float = 0.5
    max_blur_radius_px: int = 255
    kept_energy_ratio: float = 0.99
    rays_from_db: float = GEOMETRIC_FROM_DB
    is_exact: bool = False

    def __post_init__(self) -> None:
        """Raise if no cache can be built for the camera or the gaze."""
        for pitch_mrad in self.pixel_pitch_mrad:
            if not 0.005 <= pitch_mrad <= 100.0:
                raise BadMessage(
                    f"its pixels are {pitch_mrad:.3g} mrad wide",
                    field="camera",
                    allowed="0.005 to 100 mrad for a pixel on the axis",
                )
        self._check_gaze()

    def _check_gaze(self) -> None:
        """Raise if the range of gaze exceeds the field that PSFs can cover."""
        if not (self.follows_field and any(self.settings.gaze_range_deg)):
            return
        seen_deg = field_range_deg(self.camera, gaze_deg=self.settings.gaze_deg)
        turns_deg = self.settings.gaze_range_deg
        for (low, high), turn in zip(seen_deg, turns_deg, strict=True):
            if turn > 0.0 and max(-low, high) + turn > MAX_FIELD_DEG:
                raise BadMessage(
                    f"{turn:g} deg with a field of {low:.3g} to {high:.3g} deg",
                    field="settings.gaze_range_deg",
                    allowed=f"up to {MAX_FIELD_DEG:g} deg in total",
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
        """Return whether PSFs differ over the visual field."""
        return self.settings.follows_field

    @property
    def field_range_deg(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of the field directions (h, v) for which PSFs are needed."""
        if not self.follows_field:
            return (0.0, 0.0), (0.0, 0.0)
        ranges = [
            field_range_deg(self.camera, gaze_deg=gaze_deg)
            for gaze_deg in self.gaze_samples_deg()
        ]
        h_deg, v_deg = (
            (min(r[axis][0] for r in ranges), max(r[axis][1] for r in ranges))
            for axis in range(2)
        )
        if self.settings.grid == "planned":
            return h_deg, v_deg
        reach_h, reach_v = PAPER_REACH_DEG[self.settings.mode]
        return (
            (min(h_deg[0], -reach_h), max(h_deg[1], reach_h)),
            (min(v_deg[0], -reach_v), max(v_deg[1], reach_v)),
        )

    @property
    def psf_accuracy(self) -> str:
        """Accuracy of wave-optical PSFs, see `estimator.psf.compute_psf_batch`."""
        is_fine = self.is_exact and self.settings.mode != "dynamic"
        return "fine" if is_fine else "normal"

    @property
    def blends_at_equal_blur(self) -> bool:
        """Return whether field nodes are blended at equal defocus, not equal distance.

        Planned nodes cover the defocus at which their neighbors are blended.  In the
        paper's grid, each node has its own nine object distances.
        """
        return self.settings.grid == "planned"

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Wavelengths of red, green and blue."""
        return display_wavelengths_nm(self.settings.display)

    @property
    def channel_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (3,) of the channels; equal without chromatic blur."""
        if not self.settings.chromatic:
            return np.full(len(self.wavelengths_nm), REFERENCE_WAVELENGTH_NM)
        return np.array(self.wavelengths_nm)

    @property
    def primary_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (n, 3) whose PSFs are averaged for each channel."""
        middle_nm = self.channel_wavelengths_nm
        if not (self.settings.chromatic and self.settings.wide_primaries):
            return middle_nm[None]
        widths_nm = np.array(display_widths_nm(self.settings.display))
        return np.stack([middle_nm - widths_nm, middle_nm + widths_nm])

    @property
    def traced_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (n,) at which the eye is evaluated, ascending."""
        every = (self.channel_wavelengths_nm, self.primary_wavelengths_nm.ravel())
        return np.unique(np.concatenate(every))

    def blur_px_per_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the radius of the geometric blur disc on axis per diopter, px."""
        return pupil_diameter_mm / 2.0 / min(self.pixel_pitch_mrad)

    @property
    def object_ranges_dpt(self) -> list[tuple[float, float]]:
        """Object distances, dpt: one range, or one for each plane.

        Toward the corners of the image a plane is farther away than on the axis.
        """
        planes_dpt = self.settings.object_planes_dpt
        if not planes_dpt:
            return [self.settings.object_range_dpt]
        corner_ratio = self.camera.corner_distance_ratio
        return [
            (
                max(plane_dpt - PLANE_HALF_THICKNESS_DPT, 0.0) / corner_ratio,
                plane_dpt + PLANE_HALF_THICKNESS_DPT,
            )
            for plane_dpt in planes_dpt
        ]

    @property
    def object_range_dpt(self) -> tuple[float, float]:
        """Farthest and nearest object, dpt."""
        ranges = self.object_ranges_dpt
        return min(low for low, _ in ranges), max(high for _, high in ranges)

    def gaze_samples_deg(self) -> list[tuple[float, float]]:
        """Return gaze directions over the range: its middle, edges and corners."""
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
        self,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        *,
        gaze_deg: tuple[float, float] | None = None,
    ) -> NDArray[np.float64]:
        """Return the local scale (..., 2, 2) of the image at field directions.

        The on-axis mode uses the scale on the axis everywhere.
        """
        if not self.follows_field:
            axis = np.diag(1.0 / np.array(self.pixel_pitch_mrad))
            return np.broadcast_to(axis, (*np.shape(h_deg), 2, 2))
        gaze_deg = self.settings.gaze_deg if gaze_deg is None else gaze_deg
        return pixel_from_mrad(self.camera, h_deg, v_deg, gaze_deg=gaze_deg)

    def node_pixel_from_mrad(
        self, h_deg: ArrayLike, v_deg: ArrayLike
    ) -> NDArray[np.float64]:
        """Return the pixel scale (..., 2, 2) of the stored kernels of a field node.

        It is the scale of the image at the node's position.  If the gaze moves nodes
        over the image, it is the scale on the axis, reduced to the smallest pixel at
        these positions, so that frames average stored pixels and never enlarge them.
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
    """Return the allowed blur difference to the next node at a blur radius."""
    step_px = min(max(BLUR_STEP_RATIO * blur_px, MIN_BLUR_STEP_PX), max_blur_step_px)
    return max(step_px, LARGE_BLUR_STEP_RATIO * blur_px)


def pupil_nodes_mm(pupil_range_mm: tuple[float, float]) -> NDArray[np.float64]:
    """Return the cache's pupil diameters, in geometric progression over the range."""
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
    """Return nodes like `defocus_nodes_dpt`, for a lens with several foci.

    Each focus inside the range is a node.  Steps depend on the nearest focus.
    """
    inside = foci_dpt[(foci_dpt > low_dpt) & (foci_dpt < high_dpt)]
    ends = np.unique(np.concatenate([[low_dpt], inside, [high_dpt]]))
    nodes = [ends[:1]]
    for first, last in pairwise(ends.tolist()):
        at_dpt = np.linspace(first, last, FOCUS_SAMPLES)
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
    """Return nodes of total defocus that cover a range, ascending.

    Zero is a node if it lies in the range, so that an object in focus is not
    interpolated.
    """

    def outward(limit_dpt: float) -> list[float]:
        nodes = [0.0]
        while nodes[-1] < limit_dpt:
            blur_px = nodes[-1] * blur_px_per_dpt
            nodes.append(
                nodes[-1] + blur_step_px(blur_px, max_blur_step_px) / blur_px_per_dpt
            )
        return nodes

    negative = [-t for t in outward(max(-low_dpt, 0.0))]
    nodes = np.unique(np.array(negative + outward(max(high_dpt, 0.0))))
    first = max(int(np.searchsorted(nodes, low_dpt, side="right")) - 1, 0)
    last = min(int(np.searchsorted(nodes, high_dpt, side="left")), len(nodes) - 1)
    return nodes[first : last + 1]
