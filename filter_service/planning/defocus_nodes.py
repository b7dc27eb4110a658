"""Nodes of total defocus: denser where PSFs are sharper, and only where frames read.

There are two variants.  Either a node is the same defocus for all channels, which suits
deep scenes.  Or it is the defocus of green, and red and blue are shifted by their
chromatic differences, which suits few object distances, because frames read the three
channels of a distance together.  Each group uses the variant with fewer nodes.

The layers of frames depend on this blur, so it must not depend on which PSFs have been
computed.  Landing points of rays are linear in defocus, so two values of defocus
suffice for each group.

In the paper's grid, angles and distances come from the released code.  Its foci
become nodes of accommodation.  Its object distances become nodes of the total defocus
of green light, and the other channels are shifted by their chromatic differences.

References
----------
Csoba & Kunkli 2023, section 7.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.native.records import pointer_to
from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.pupil import pupil_frames
from filter_service.constants import RGB
from filter_service.errors import GridTooLarge
from filter_service.native import loops
from filter_service.native.records import NodeJob
from filter_service.planning.grid import GREEN, PAPER_REACH_DEG, GridSpec
from filter_service.planning.node_wavefronts import (
    NodeWavefronts,
    PupilStates,
    main_foci_dpt,
    main_light_ratio,
    slopes_px,
)
from filter_service.planning.nodes import (
    PlanAxes,
    RaggedNodes,
    ReadableDefocus,
    joined_ranges,
)
from filter_service.planning.state_samples import (
    BLUR_EXPONENT,
    DIFFRACTION_SHARE,
    DOUBLING,
    OWN_SHARE,
    SHARP_PX,
    half_way_error,
    mean_square,
    spot_covariance,
    unit_px,
)


class GroupRays(NamedTuple):
    """Landing points of each group's green rays at 0 dpt, and their shift per diopter.

    Attributes
    ----------
    zero_px, per_dpt : (n_groups, n_rays, 2)
        In px.
    """

    zero_px: NDArray[np.float64]
    per_dpt: NDArray[np.float64]

    @classmethod
    def of(cls, wavefronts: NodeWavefronts) -> GroupRays:
        """Trace rays through wavefronts, averaged over the wavelengths of a primary."""
        zero_um = wavefronts.zernike_um[:, GREEN].mean(axis=1)
        per_dpt_um = wavefronts.per_dpt_um[:, GREEN].mean(axis=1)
        both = (2, 1)
        slopes = slopes_px(
            pupil_frames(
                wavefront_polynomial(np.concatenate([zero_um, zero_um + per_dpt_um])),
                circle_radius_mm=np.tile(
                    wavefronts.circle_diameter_mm[:, GREEN, 0] / 2.0, 2
                ),
                wavelength_nm=np.full(
                    2 * len(zero_um), wavefronts.wavelength_nm[GREEN].mean()
                ),
                pixel_from_mrad=np.tile(wavefronts.pixel_from_mrad, (*both, 1)),
                pupil_ellipse=np.tile(wavefronts.pupil_ellipse[:, GREEN, 0], both),
            )
        )
        at_zero_px, at_one_px = np.split(slopes, 2)
        return cls(at_zero_px, at_one_px - at_zero_px)


def node_blur_px(
    eye: EyeOptics,
    spec: GridSpec,
    rays: GroupRays,
    nodes: RaggedNodes,
    channel_shift_dpt: NDArray[np.float64],
    shrink_ratio: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the largest distance (n_psfs,), px, of rays from the chief ray.

    With several foci, these are the rays of the nearest focus.
    """
    foci_dpt = np.zeros((RGB, 1))
    if eye.rings is not None:
        own_dpt = [
            eye.rings.main_dpt(nm) for nm in spec.channel_wavelengths_nm.tolist()
        ]
        foci_dpt = np.full((RGB, max(map(len, own_dpt))), np.inf)
        for channel, found in enumerate(own_dpt):
            foci_dpt[channel, : len(found)] = found
    zero_px, per_dpt = (np.ascontiguousarray(px.swapaxes(1, 2)) for px in rays)
    blur_px = np.empty(RGB * nodes.values_dpt.size, np.float32)
    loops().call(
        "node_blur",
        *(zero_px, per_dpt, nodes.values_dpt, nodes.starts),
        np.ascontiguousarray(channel_shift_dpt),
        *(foci_dpt, blur_px),
        *(len(zero_px), zero_px.shape[2], foci_dpt.shape[1]),
    )
    return blur_px * np.repeat(shrink_ratio, RGB * nodes.counts).astype(np.float32)


_SAMPLES = 49

_LARGEST_RATIO = 0.86
"""Limit of the distance of rays, as a share of the largest kernel radius.  The rest of
the radius is for diffraction and the rim of the spot."""

EXACT_DPT = 1e-9
"""Ranges narrower than this are treated as one value."""

DEEP_DPT = 6.0
"""Width of a range above which chromatic shifts save too little to be tried."""

MAX_GROUP_NODES = 100_000
"""Largest number of nodes in a group.  The largest blur, 255 px, takes 1,000 steps of
0.25 px."""

Ranges = list[NDArray[np.float64]]


@dataclass(frozen=True)
class DefocusNodes:
    """Nodes of total defocus of all groups of a plan; fields as in `PlanNodes`."""

    nodes: RaggedNodes
    channel_shift_dpt: NDArray[np.float64]
    is_limited: NDArray[np.bool_]
    shrink_ratio: NDArray[np.float64]

    @classmethod
    def unlimited(
        cls, nodes: RaggedNodes, channel_shift_dpt: NDArray[np.float64]
    ) -> DefocusNodes:
        """Return nodes of groups that are neither limited nor shrunk."""
        count = len(nodes.starts) - 1
        return cls(nodes, channel_shift_dpt, np.zeros(count, bool), np.ones(count))


def defocus_nodes(
    eye: EyeOptics,
    spec: GridSpec,
    groups: PupilStates,
    group_rays: GroupRays,
    readable: ReadableDefocus,
    *,
    allowed_error: float,
) -> DefocusNodes:
    """Return the nodes of total defocus of every group for an allowed error.

    Parameters
    ----------
    groups : PupilStates
        Field nodes (P,) of one state, in green light without defocus.
    group_rays : GroupRays
    readable : ReadableDefocus
    """
    rays = _Rays.of(eye, spec, groups, group_rays, allowed_error=allowed_error)
    split = joined_ranges(readable.all_channels_dpt)
    whole_dpt = np.array([[own[0, 0], own[-1, 1]] for own in split])
    limited_dpt, shrink_ratio = rays.limited(whole_dpt, spec, groups)
    is_limited = np.any(limited_dpt != whole_dpt, axis=1)
    every = np.arange(len(split))
    nodes = rays.nodes(every, list(limited_dpt[:, None]))
    shift_dpt = np.zeros((len(split), RGB))
    free = np.flatnonzero(~is_limited)

    def replace_where_fewer(
        index: NDArray[np.int64], ranges: Ranges, shifts_dpt: Any = None
    ) -> None:
        nonlocal nodes
        if not index.size:
            return
        nodes, replaced = nodes.where_fewer(
            index, rays.nodes(index, ranges, shifts_dpt)
        )
        shift_dpt[index[replaced]] = 0.0 if shifts_dpt is None else shifts_dpt[replaced]

    several = free[[len(split[k]) > 1 for k in free.tolist()]]
    replace_where_fewer(several, [split[k] for k in several.tolist()])
    narrow = free[np.ptp(whole_dpt[free], axis=1) < DEEP_DPT]
    shifted = joined_ranges(readable.without_shift_dpt[narrow])
    hulls = [np.array([[own[0, 0], own[-1, 1]]]) for own in shifted]
    replace_where_fewer(narrow, hulls, readable.shift_dpt[narrow])
    if any(len(own) > 1 for own in shifted):
        replace_where_fewer(narrow, shifted, readable.shift_dpt[narrow])
    return DefocusNodes(nodes, shift_dpt, is_limited, shrink_ratio)


def limited_defocus(
    eye: EyeOptics,
    spec: GridSpec,
    groups: PupilStates,
    group_rays: GroupRays,
    ranges_dpt: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Clip ranges (P, 2) of total defocus to those with small enough kernels.

    Returns
    -------
    limited_dpt : (P, 2)
    shrink_ratio : (P,)
        Ratio that shrinks the smallest kernel of a range to the limit; one if it fits.
    """
    rays = _Rays.of(eye, spec, groups, group_rays, allowed_error=1.0)
    return rays.limited(ranges_dpt, spec, groups)


@dataclass(frozen=True)
class _Rays:
    """Landing points of the rays of each group (P,), in px and linear in defocus.

    Attributes
    ----------
    zero_px, per_dpt : (P, n, 2)
    covariance : (P, 4, 3)
        The covariance xx, yy, xy of the spot, px², as polynomials in defocus of three
        coefficients; then the mean square shift of rays per diopter.
    unit_px : (P,)
    half_way_error : float
        RMS error half-way between nodes.
    foci_dpt : (n_foci,)
        Total defocus of each focus: 0, and others with a multifocal lens.
    light_ratio : (n_foci, P)
        Share of the light in each focus.
    reach_px : (P,)
        Distance beyond the rays to which a multifocal lens sends light.
    """

    zero_px: NDArray[np.float64]
    per_dpt: NDArray[np.float64]
    covariance: NDArray[np.float64]
    unit_px: NDArray[np.float64]
    half_way_error: float
    foci_dpt: NDArray[np.float64]
    light_ratio: NDArray[np.float64]
    reach_px: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        eye: EyeOptics,
        spec: GridSpec,
        groups: PupilStates,
        rays: GroupRays,
        *,
        allowed_error: float,
    ) -> _Rays:
        zero_px, per_dpt = rays
        at_zero, at_one, spread = map(
            spot_covariance, (zero_px, zero_px + per_dpt, per_dpt)
        )
        covariance = np.zeros((len(zero_px), 4, 3))
        covariance[:, :3] = np.stack([at_zero, at_one - at_zero - spread, spread], -1)
        covariance[:, 3, 0] = mean_square(per_dpt)
        error = half_way_error("defocus", allowed_error)
        return cls(
            zero_px,
            per_dpt,
            covariance,
            unit_px(spec, groups),
            error,
            main_foci_dpt(eye, spec),
            main_light_ratio(eye, spec, groups.pupil_diameter_mm / 2.0),
            _reach_px(eye, spec, groups),
        )

    def nodes(
        self,
        index: NDArray[np.int64],
        ranges: Ranges,
        shifts_dpt: NDArray[np.float64] | None = None,
    ) -> RaggedNodes:
        """Return the nodes of groups (n,) over the ranges (k, 2) of each group."""
        counts = [len(own) for own in ranges]
        lows, highs = np.concatenate(ranges).T
        place = np.repeat(np.arange(index.size), counts)
        shifts = np.zeros((1, lows.size))
        if shifts_dpt is not None:
            shifts = shifts_dpt[place].T
        needed = self._needed_intervals(index[place], lows, highs, shifts)
        values, sizes = _spread(lows, highs, needed)
        first = np.cumsum(counts) - counts
        return RaggedNodes.joined(
            values, np.add.reduceat(sizes, first.astype(np.int64))
        )

    def _needed_intervals(
        self,
        groups: NDArray[np.int64],
        lows: NDArray[np.float64],
        highs: NDArray[np.float64],
        shifts_dpt: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the intervals (n, n_samples) needed up to each sample of ranges (n,).

        Parameters
        ----------
        shifts_dpt : (n_shifts, n)
            Chromatic shifts, added to the defocus of nodes.
        """
        needed = np.empty((lows.size, _SAMPLES))
        arrays = {
            "covariance": self.covariance,
            "unit_px": self.unit_px,
            "light_ratio": self.light_ratio,
            "foci_dpt": self.foci_dpt,
            "lows": lows,
            "highs": highs,
            "shifts_dpt": shifts_dpt,
            "needed": needed,
        }
        kept = {
            name: np.ascontiguousarray(array, np.float64)
            for name, array in arrays.items()
        }
        groups = np.ascontiguousarray(groups, np.int64)
        job = NodeJob(
            **{name: pointer_to(array) for name, array in kept.items()},
            groups=pointer_to(groups),
            error=self.half_way_error,
            doubling=DOUBLING,
            blur_exponent=BLUR_EXPONENT,
            sharp_px=SHARP_PX,
            own_share=OWN_SHARE,
            diffraction_share=DIFFRACTION_SHARE,
            n=lows.size,
            n_groups=self.unit_px.size,
            n_foci=self.foci_dpt.size,
            n_shifts=len(shifts_dpt),
            n_samples=_SAMPLES,
        )
        loops().call("needed_intervals", job)
        return needed

    def limited(
        self, ranges_dpt: NDArray[np.float64], spec: GridSpec, groups: PupilStates
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Clip ranges (P, 2) to the defocus at which kernels are small enough.

        If no kernel in a range is small enough, the range becomes the defocus of the
        smallest one, with the ratio (P,) that shrinks it to the limit.  On the axis,
        the range stays as it is, so that computing its kernels raises an error with
        numbers: the object that the eye looks at is never drawn shrunk.
        """
        lows, highs = ranges_dpt.T
        limit_px = _LARGEST_RATIO * spec.max_blur_radius_px - self.reach_px
        first_dpt, last_dpt, discriminant = self._within(limit_px)
        fits = (discriminant > 0.0).all(axis=1) & (
            np.maximum(first_dpt, lows) <= np.minimum(last_dpt, highs)
        )
        limited_dpt = np.where(
            fits[:, None],
            np.stack(
                [np.maximum(first_dpt, lows), np.minimum(last_dpt, highs)], axis=-1
            ),
            ranges_dpt,
        )
        away_deg = np.hypot(groups.h_deg, groups.v_deg)
        shrunk = np.flatnonzero(~fits & (away_deg > away_deg.min() + 1e-9))
        ratio = np.ones(lows.size)
        if shrunk.size:
            at_dpt = np.linspace(lows[shrunk], highs[shrunk], _SAMPLES)
            slopes = (
                self.zero_px[shrunk] + at_dpt[..., None, None] * self.per_dpt[shrunk]
            )
            largest_px = np.sqrt((slopes**2).sum(axis=-1)).max(axis=-1)
            best, at = largest_px.argmin(axis=0), np.arange(shrunk.size)
            limited_dpt[shrunk] = at_dpt[best, at][:, None]
            ratio[shrunk] = limit_px[shrunk] / largest_px[best, at]
        return limited_dpt, ratio

    def _within(
        self, limit_px: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the first and last defocus (P,) with all rays within a limit.

        They solve |zero + t per|² = limit² for each ray.  The third result is the
        discriminant (P, n), which is positive if a ray is within the limit at some
        defocus.
        """
        a = np.maximum((self.per_dpt**2).sum(axis=-1), 1e-12)
        half_b = (self.zero_px * self.per_dpt).sum(axis=-1)
        beyond = (self.zero_px**2).sum(axis=-1) - limit_px[:, None] ** 2
        discriminant = half_b**2 - a * beyond
        reach = np.sqrt(np.maximum(discriminant, 0.0))
        return (
            ((-half_b - reach) / a).max(axis=1),
            ((-half_b + reach) / a).min(axis=1),
            discriminant,
        )


def _reach_px(
    eye: EyeOptics, spec: GridSpec, groups: PupilStates
) -> NDArray[np.float64]:
    if eye.rings is None:
        return np.zeros(groups.h_deg.size)
    reaches = [
        eye.rings.reach_mrad(groups.pupil_diameter_mm / 2.0, nm)
        for nm in spec.channel_wavelengths_nm.tolist()
    ]
    return np.max(reaches, axis=0) / min(spec.pixel_pitch_mrad)


def _spread(
    lows: NDArray[np.float64], highs: NDArray[np.float64], needed: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the nodes that cover ranges (n,), and the number in each range."""
    is_range = highs - lows >= EXACT_DPT
    bad = np.flatnonzero(is_range & ~(needed[:, -1] <= MAX_GROUP_NODES))  # or NaN
    if bad.size:
        k = int(bad[0])
        raise GridTooLarge(
            f"defocus from {lows[k]:.4g} to {highs[k]:.4g} dpt needs "
            f"{needed[k, -1]:.3g} PSFs at one position in the image",
            field="settings.object_range_dpt",
            allowed=f"ranges and an eye that need at most {MAX_GROUP_NODES:,}",
        )
    # PSFs may be so wide that no difference is visible: two nodes.
    steps = np.maximum(np.ceil(needed[:, -1] - 1e-9), 1.0)
    counts = np.where(is_range, 1.0 + steps, 1.0).astype(np.int64)
    nodes = np.empty(counts.sum())
    count = loops().call(
        "spread_nodes",
        *(np.ascontiguousarray(lows), np.ascontiguousarray(highs)),
        *(np.ascontiguousarray(needed), counts, nodes, *needed.shape),
    )
    return nodes[:count], counts


ANGLE_COUNTS = {"on-axis": (1, 1), "quality": (31, 21), "dynamic": (23, 13)}
DISTANCE_COUNTS = {"on-axis": 33, "quality": 9, "dynamic": 9}
PUPILS_MM = {
    "on-axis": (2.0, 3.0, 4.0, 5.0, 6.0, 7.0),
    "quality": (5.0,),
    "dynamic": (2.0, 3.0, 4.0, 5.0, 6.0),
}
FOCI_DPT = {
    "on-axis": tuple(0.125 + np.arange(7.0)),
    "quality": (0.125,),
    "dynamic": tuple(0.125 + np.arange(5.0)),
}
DISTANCES_DPT = (0.125, 8.125)


def paper_ranges(
    spec: GridSpec,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of the nodes of pupil, mm, and focus, dpt."""
    settings = spec.settings
    pupils_mm = np.clip(PUPILS_MM[settings.mode], *settings.pupil_range_mm)
    foci_dpt = np.clip(FOCI_DPT[settings.mode], *settings.focus_range_dpt)
    return (
        (float(pupils_mm[0]), float(pupils_mm[-1])),
        (float(foci_dpt[0]), float(foci_dpt[-1])),
    )


def paper_pupils_mm(eye: EyeOptics, spec: GridSpec) -> NDArray[np.float64]:
    """Return the nodes (n,) of the pupil, clamped to the ranges of settings and eye."""
    pupils_mm = np.clip(PUPILS_MM[spec.settings.mode], *spec.settings.pupil_range_mm)
    return np.unique([eye.usable_pupil_mm(pupil_mm) for pupil_mm in pupils_mm])


def paper_axes(eye: EyeOptics, spec: GridSpec) -> PlanAxes:
    """Return the nodes of field, pupil and accommodation.

    Pupils and foci are clamped to the ranges of the settings.  Foci with the same
    accommodation, such as foci of a myopic eye beyond its far point, are one node.
    """
    settings, mode = spec.settings, spec.settings.mode
    reach_deg = PAPER_REACH_DEG.get(mode, (0.0, 0.0))
    angles_deg = (
        np.linspace(-reach, reach, count)
        for reach, count in zip(reach_deg, ANGLE_COUNTS[mode], strict=True)
    )
    foci_dpt = np.clip(FOCI_DPT[mode], *settings.focus_range_dpt)
    usable_mm = paper_pupils_mm(eye, spec)
    widest_mm = float(usable_mm[-1])
    accommodations_dpt = np.unique(
        [eye.accommodation_dpt(f, pupil_diameter_mm=widest_mm) for f in foci_dpt]
    )
    # The ends need other accommodations through smaller pupils.
    low_dpt, high_dpt = eye.accommodation_range_dpt(
        (float(foci_dpt[0]), float(foci_dpt[-1])),
        pupil_range_mm=(float(usable_mm[0]), widest_mm),
    )
    accommodations_dpt = np.unique([low_dpt, *accommodations_dpt[1:-1], high_dpt])
    h_deg, v_deg = angles_deg
    return PlanAxes(h_deg, v_deg, usable_mm, accommodations_dpt)


def paper_defocus(eye: EyeOptics, spec: GridSpec, groups: PupilStates) -> DefocusNodes:
    """Return the nodes of total defocus of groups, with the shifts of the channels."""
    at_infinity_dpt = eye.total_defocus_dpt(
        h_deg=groups.h_deg[:, None],
        v_deg=groups.v_deg[:, None],
        pupil_diameter_mm=groups.pupil_diameter_mm[:, None],
        accommodation_dpt=groups.accommodation_dpt[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    green_dpt = at_infinity_dpt[:, GREEN, None]
    count = DISTANCE_COUNTS[spec.settings.mode]
    distances_dpt = np.linspace(*DISTANCES_DPT, count)
    values = green_dpt + eye.vergence.vergence_dpt(distances_dpt)
    starts = count * np.arange(len(values) + 1)
    return DefocusNodes.unlimited(
        RaggedNodes(values.ravel(), starts), at_infinity_dpt - green_dpt
    )
