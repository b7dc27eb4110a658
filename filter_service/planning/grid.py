"""Where the PSF cache has its nodes, and where a frame has its layers.

The cache is spanned by pupil and *total defocus* (refraction + object vergence -
accommodation + chromatic shift): object distance, focus and wavelength act on an
on-axis PSF through that sum alone, so a node serves every combination that shares it.
Frame layers follow the paper: object distances uniform in dioptres plus transitional
layers wherever the blur changes by more than a step (section 6.2, Eq. 8).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.units import (
    MRAD_PER_RAD,
    REFERENCE_WAVELENGTH_NM,
    RGB_WAVELENGTHS_NM,
)
from filter_service.planning.field_directions import (
    MAX_FIELD_DEG,
    field_range_deg,
    nearest_inside_deg,
    pixel_from_mrad,
)
from filter_service.wire.images import MAX_GAZE_DEG, Camera

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


MODES = ("on-axis", "quality", "dynamic")
"""One kernel set for the whole image; or, over the visual field, the finer and the
coarser grid (of the planner, or of the paper)."""

PAPER_REACH_DEG = {"quality": (45.0, 25.0), "dynamic": (45.0, 24.0)}
"""Azimuth and elevation to both sides (released code)."""

GRIDS = ("planned", "paper")
TOLERANCES = ("loose", "normal", "fine")


@dataclass(frozen=True)
class GridSpec:
    """What a PSF cache is built for.

    Attributes
    ----------
    camera : Camera
        Image size and tangents; the on-axis mode uses no more than its pixel pitch.
    pupil_range_mm, object_range_dpt, focus_range_dpt : (float, float)
        Entrance pupils, object distances and focus distances that frames may ask for.
    wavelengths_nm : (float, float, float)
        For red, green, blue.
    diffraction, chromatic : bool
        Off: geometrical optics; all channels at the reference wavelength.
    lateral_color : bool
        The channels' images of a point lie apart, as their chief rays do; green stays.
    mode : "on-axis", "quality" or "dynamic"
        Whether PSFs follow the visual field, and over how fine a grid.
    grid : "planned" or "paper"
        Nodes where this eye needs them, or the paper's fixed ones (section 7.2).
    tolerance : "loose", "normal" or "fine"
        How much interpolation between planned nodes may cost.
    gaze_deg : (h, v)
        Where the eye looks within the camera's image.
    gaze_range_deg : (h, v)
        How far frames may turn the gaze from there, to either side.
    memory_budget_mb : float
        A larger plan is refused.
    max_blur_step_px : float
        Blur difference between neighbouring nodes.
    max_blur_radius_px : int
        A kernel larger than this is refused.
    kept_energy_ratio : float
        Light within a kernel's box; the rest is spread over it again.  0.99 keeps
        filtered images at 60 dB or more of the uncut kernel's, 0.995 at 65 dB, 0.998
        at 67 dB (240 kernels over the field, 2.5 to 6 mm).
    """

    camera: Camera
    pupil_range_mm: tuple[float, float] = (2.0, 7.0)
    object_range_dpt: tuple[float, float] = (0.0, 10.0)
    focus_range_dpt: tuple[float, float] = (0.0, 6.0)
    wavelengths_nm: tuple[float, float, float] = RGB_WAVELENGTHS_NM
    diffraction: bool = True
    chromatic: bool = True
    lateral_color: bool = False
    mode: str = "on-axis"
    grid: str = "planned"
    tolerance: str = "normal"
    gaze_deg: tuple[float, float] = (0.0, 0.0)
    gaze_range_deg: tuple[float, float] = (0.0, 0.0)
    memory_budget_mb: float = 2000.0
    max_blur_step_px: float = 0.5
    max_blur_radius_px: int = 255
    kept_energy_ratio: float = 0.99

    def __post_init__(self):
        _check_range("pupil_range_mm", self.pupil_range_mm, 0.5, 9.0)
        _check_range("object_range_dpt", self.object_range_dpt, 0.0, 100.0)
        _check_range("focus_range_dpt", self.focus_range_dpt, 0.0, 20.0)
        for name, options in (
            ("mode", MODES),
            ("grid", GRIDS),
            ("tolerance", TOLERANCES),
        ):
            if getattr(self, name) not in options:
                raise ValueError(
                    f"{name} {getattr(self, name)!r}: allowed are {', '.join(options)}"
                )
        for pitch_mrad in self.pixel_pitch_mrad:
            if not 0.005 <= pitch_mrad <= 100.0:
                raise ValueError(
                    f"pixel_pitch_mrad {self.pixel_pitch_mrad}: 0.005 to 100 allowed"
                )
        self._check_gaze()

    def _check_gaze(self) -> None:
        """Refuse a gaze no eye has, or one that turns the image out of all PSFs."""
        for name, low_deg in (("gaze_deg", -MAX_GAZE_DEG), ("gaze_range_deg", 0.0)):
            values = getattr(self, name)
            if not all(low_deg <= value <= MAX_GAZE_DEG for value in values):
                raise ValueError(
                    f"{name} {values}: allowed are {low_deg:g} to {MAX_GAZE_DEG:g}"
                )
        if not (self.follows_field and any(self.gaze_range_deg)):
            return
        seen_deg = field_range_deg(self.camera, gaze_deg=self.gaze_deg)
        for (low, high), turn in zip(seen_deg, self.gaze_range_deg, strict=True):
            if turn > 0.0 and max(-low, high) + turn > MAX_FIELD_DEG:
                raise ValueError(
                    f"gaze_range_deg {self.gaze_range_deg}: {turn:g} beside a field of "
                    f"{low:.3g} to {high:.3g} deg; allowed: {MAX_FIELD_DEG:g} together"
                )

    @classmethod
    def for_camera(
        cls, *, width_px: int, height_px: int, tangents: tuple, **settings
    ) -> "GridSpec":
        """Spec for a camera given by its parts; other settings as given."""
        return cls(camera=Camera(width_px, height_px, tuple(tangents)), **settings)

    @property
    def pixel_pitch_mrad(self) -> tuple[float, float]:
        """Width and height of the pixel on the camera's axis."""
        return pixel_pitch_mrad(
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            tangents=self.camera.tangents,
        )

    @property
    def follows_field(self) -> bool:
        """Whether PSFs differ over the visual field."""
        return self.mode != "on-axis"

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
        if self.grid == "planned":
            return seen_deg
        return tuple(
            (min(low, -reach), max(high, reach))
            for (low, high), reach in zip(
                seen_deg, PAPER_REACH_DEG[self.mode], strict=True
            )
        )

    @property
    def blends_at_equal_blur(self) -> bool:
        """Whether field nodes are blended at equal defocus, not at equal distance.

        Nodes that the planner chose hold the defocus that their neighbours read; the
        paper's hold nine object distances of their own.
        """
        return self.grid == "planned"

    @property
    def channel_wavelengths_nm(self) -> NDArray[np.float64]:
        """Wavelengths (3,) of the channels; all the same without chromatic blur."""
        if not self.chromatic:
            return np.full(len(self.wavelengths_nm), REFERENCE_WAVELENGTH_NM)
        return np.array(self.wavelengths_nm)

    def blur_px_per_dpt(self, pupil_diameter_mm: float) -> float:
        """Radius of the geometric blur disc on axis per dioptre of defocus, px."""
        return pupil_diameter_mm / 2.0 / min(self.pixel_pitch_mrad)

    def gaze_samples_deg(self) -> list[tuple[float, float]]:
        """Directions of gaze over the range: its middle, edges and corners."""
        steps = [
            (-reach, 0.0, reach) if reach > 0.0 else (0.0,)
            for reach in self.gaze_range_deg
        ]
        return [
            (self.gaze_deg[0] + h, self.gaze_deg[1] + v)
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
        gaze_deg = self.gaze_deg if gaze_deg is None else gaze_deg
        return pixel_from_mrad(self.camera, h_deg, v_deg, gaze_deg=gaze_deg)

    def node_pixel_from_mrad(self, h_deg, v_deg) -> NDArray[np.float64]:
        """Scale (..., 2, 2) of the pixels that kernels of a field node are stored in.

        That of the image where the node is seen.  A node that the gaze moves over the
        image has the pixels of its axis, made so much smaller that no place in the
        image has smaller ones: frames then only ever average stored pixels.
        """
        if not any(self.gaze_range_deg) or not self.follows_field:
            return self.pixel_from_mrad(h_deg, v_deg)
        axis = np.diag(1.0 / np.array(self.pixel_pitch_mrad))
        finest = np.ones(np.shape(h_deg))
        for gaze_deg in self.gaze_samples_deg():
            inside = nearest_inside_deg(self.camera, h_deg, v_deg, gaze_deg=gaze_deg)
            local = self.pixel_from_mrad(*inside, gaze_deg=gaze_deg)
            ratio = np.linalg.norm(np.linalg.solve(axis, local), ord=2, axis=(-2, -1))
            finest = np.maximum(finest, ratio)
        return finest[..., None, None] * axis


def _check_range(name: str, values: tuple, low: float, high: float) -> None:
    first, last = values
    if not (
        math.isfinite(first) and math.isfinite(last) and low <= first <= last <= high
    ):
        raise ValueError(f"{name} {values}: needs {low:g} <= first <= last <= {high:g}")


def pixel_pitch_mrad(
    *, width_px: int, height_px: int, tangents: tuple[float, float, float, float]
) -> tuple[float, float]:
    """Pixel size on the optical axis of a pinhole camera, mrad.

    Parameters
    ----------
    tangents : (left, right, up, down)
        Tangents of the view's edges; left < right, down < up.
    """
    left, right, up, down = tangents
    if not (right > left and up > down):
        raise ValueError(f"tangents {tangents}: need left < right and down < up")
    return (
        MRAD_PER_RAD * (right - left) / width_px,
        MRAD_PER_RAD * (up - down) / height_px,
    )


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


def layer_distances_dpt(
    object_range_dpt: tuple[float, float],
    *,
    focused_dpt: NDArray[np.float64],
    blur_radius_px,
    max_blur_step_px: float,
) -> NDArray[np.float64]:
    """Object distances of a frame's layers, ascending.

    Parameters
    ----------
    focused_dpt : (n,)
        Distances in focus for some channel; each becomes a layer, so that the blur is
        monotone between layers.
    blur_radius_px : callable
        (n,) distances in dpt to (n, 3) blur radii in px.
    max_blur_step_px : float

    References
    ----------
    Csoba & Kunkli 2023, Eq. 8: L = ceil(|R(k+1) - R(k)|) - 1 transitional layers, here
    with a step other than one pixel.
    """
    low_dpt, high_dpt = object_range_dpt
    count = 1 + math.ceil((high_dpt - low_dpt) / BASE_OBJECT_STEP_DPT - 1e-9)
    inside = focused_dpt[(focused_dpt > low_dpt) & (focused_dpt < high_dpt)]
    base = np.unique(
        np.concatenate([np.linspace(low_dpt, high_dpt, max(count, 1)), inside])
    )
    blur_px = blur_radius_px(base)
    change_px = np.abs(np.diff(blur_px, axis=0)).max(axis=1)
    smaller_px = np.minimum(blur_px[1:], blur_px[:-1]).min(axis=1)
    step_px = [blur_step_px(px, max_blur_step_px) for px in smaller_px.tolist()]
    steps = np.ceil(change_px / step_px - 1e-9).astype(np.int64).clip(min=1)
    return np.append(_between(base[:-1], base[1:], steps), base[-1])


def _between(
    first: NDArray[np.float64], last: NDArray[np.float64], steps: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Equal steps from each first value up to its last, the last not included."""
    stretch = np.repeat(np.arange(first.size), steps)
    step = np.arange(stretch.size) - (np.cumsum(steps) - steps)[stretch]
    return step * ((last - first) / steps)[stretch] + first[stretch]
