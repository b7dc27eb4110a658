"""Sampled states of the frames of a cache, and the errors of PSFs blended for them.

The law is a fit to 3,600 random pairs of neighbors in defocus, pupil, accommodation and
field, from five eyes, pupils of 2 to 7 mm, fields to 40 x 25 deg and pixels of 0.8 to
3.5 mrad.  Each pair was blended half and half and compared with the exact PSF between
its members on linear 720p frames of the scene *Courtyard*.

Blending has two errors.  It doubles rays that are at a distance D from each other; this
error grows with D² relative to the blur.  Where rays do not move in proportion, it also
displaces the blend from the exact PSF; this error is of first order.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.wavefront.field_wavefronts import distinct_rows
from filter_service.planning.grid import MAX_FIELD_DEG, GridSpec, field_deg
from filter_service.planning.node_wavefronts import (
    WEIGHTS,
    PupilStates,
    slopes_px,
    state_frames,
)
from filter_service.planning.nodes import (
    CachePlan,
    bracket_axis,
)

DOUBLING = 0.00463
ASIDE = 0.0248
BLUR_EXPONENT = 0.795
"""RMS error of the image, in units of white, at a difference and a blur of 1 px."""

SHARP_PX = 0.384
OWN_SHARE = 0.41
DIFFRACTION_SHARE = 2.9
"""Terms of the squared blur in addition to the rays: the pixel, px, and factors
of D² and of the squared wavelength over pupil diameter."""

AXIS_FACTOR = {
    "h": 1.15,
    "v": 1.0,
    "pupil": 0.8,
    "accommodation": 2.5,
    "defocus": 2.2,
}
"""Measured mean square error relative to the formula, by interpolated axis."""

COHERENCE = 0.09
"""Degree to which the errors of several axes add as amplitudes, because all of them
blur."""

FLOOR = 1.8e-6
"""Mean square error that denser nodes do not remove: from rims of spots that cross a
pixel edge between two nodes, and from the transition between PSF methods.  `COHERENCE`
and `FLOOR` are from 36 whole plans of three eyes, measured and predicted (spread
0.7 dB)."""

LEAST_SHARE = 0.02
"""Least share of the total error for an axis, if the other axes have used all of it."""

MEAN_OF_HALF_WAY = 8.0 / 15.0
"""Mean square over an interval of 4 f (1 - f), the error relative to its middle."""


def mean_square(vectors_px: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean (P,) over the pupil of squared vectors (P, n, 2)."""
    return (WEIGHTS[:, None] * np.square(vectors_px)).sum(axis=(-2, -1))


def spot_covariance(slopes_px: NDArray[Any]) -> NDArray[np.float64]:
    """Return the covariance (P, 3) xx, yy, xy of landing points of rays, px²."""
    centered = slopes_px - (WEIGHTS[:, None] * slopes_px).sum(axis=-2, keepdims=True)
    x, y = centered[..., 0], centered[..., 1]
    return np.stack([(x * x) @ WEIGHTS, (y * y) @ WEIGHTS, (x * y) @ WEIGHTS], axis=-1)


def _blur_px2(
    covariance_px2: NDArray[Any], difference_px2: NDArray[Any], unit_px: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the blur (P,), px²: the geometric mean of the two principal variances."""
    xx, yy, xy = np.moveaxis(covariance_px2, -1, 0)
    more = (
        SHARP_PX**2
        + OWN_SHARE * difference_px2
        + DIFFRACTION_SHARE * np.square(unit_px)
    )
    return np.sqrt(np.maximum((xx + more) * (yy + more) - xy * xy, more * more))


def blend_error(
    lower_px: NDArray[Any],
    upper_px: NDArray[Any],
    exact_px: NDArray[Any],
    *,
    share_ratio: NDArray[Any],
    unit_px: NDArray[Any],
) -> NDArray[np.float64]:
    """Return the mean square error (P,) of images filtered with blends of two PSFs.

    Parameters
    ----------
    lower_px, upper_px, exact_px : (P, n, 2)
        Slopes of the neighbors and of the exact PSF between them.
    share_ratio : (P,)
        Share of the upper neighbor.
    unit_px : (P,)
        Wavelength over pupil diameter, px.
    """
    share = share_ratio[:, None, None]
    difference_px2 = mean_square(upper_px - lower_px)
    aside_px2 = mean_square((1.0 - share) * lower_px + share * upper_px - exact_px)
    blur_px2 = _blur_px2(spot_covariance(exact_px), difference_px2, unit_px)
    half_way = 4.0 * share_ratio * (1.0 - share_ratio)
    doubled = DOUBLING * half_way * difference_px2 / blur_px2**BLUR_EXPONENT
    # The error of a displacement beyond the blur saturates: image contrast is limited.
    aside_square = (
        ASIDE**2 * aside_px2 * (blur_px2 + aside_px2) ** (1.0 - 2.0 * BLUR_EXPONENT)
    )
    return doubled**2 + aside_square


def allowed_difference_px(
    covariance_px2: NDArray[Any],
    *,
    unit_px: NDArray[Any],
    half_way_error: float | NDArray[Any],
) -> NDArray[np.float64]:
    """Return the RMS difference (P,) of neighbors that causes an error half-way.

    Parameters
    ----------
    covariance_px2 : (P, 3)
        See `spot_covariance`.
    """
    difference_px2 = np.zeros(covariance_px2.shape[:-1])
    for _ in range(12):  # a contraction: the blur grows slower than the difference
        blur_px2 = _blur_px2(covariance_px2, difference_px2, unit_px)
        difference_px2 = half_way_error / DOUBLING * blur_px2**BLUR_EXPONENT
    return np.sqrt(difference_px2)


def half_way_error(axis: str, allowed_error: float) -> float:
    """Return the RMS error half-way between nodes for a mean square error."""
    return float(np.sqrt(allowed_error / MEAN_OF_HALF_WAY / AXIS_FACTOR[axis]))


def combined_error(errors: list[float]) -> float:
    """Return the mean square error of several interpolations together."""
    amplitude = float(np.sum(np.sqrt(errors)))
    return FLOOR + (1.0 - COHERENCE) * float(np.sum(errors)) + COHERENCE * amplitude**2


def equal_share(allowed_error: float, *, spent: list[float], count: int) -> float:
    """Return the mean square error that each remaining interpolation may add.

    Parameters
    ----------
    spent : list
        Errors of the interpolations whose nodes are known.
    count : int
        Number of remaining interpolations, which share equally.
    """
    # combined_error is a quadratic polynomial of their amplitude.
    square = (1.0 - COHERENCE) * count + COHERENCE * count**2
    linear = COHERENCE * count * float(np.sum(np.sqrt(spent)))
    left = allowed_error - combined_error(spent)
    if left <= 0.0:
        return LEAST_SHARE * allowed_error
    amplitude = (np.sqrt(linear**2 + square * left) - linear) / square
    return max(float(amplitude**2), LEAST_SHARE * allowed_error)


def psnr_db(mean_square_error: float) -> float:
    """Return the PSNR for a white of 1."""
    return float(-10.0 * np.log10(max(mean_square_error, 1e-12)))


AXES = ("h", "v", "pupil", "accommodation", "defocus")
FIELD_OF_AXIS = {
    "h": "h_deg",
    "v": "v_deg",
    "pupil": "pupil_diameter_mm",
    "accommodation": "accommodation_dpt",
}

_PLASTIC = 1.1127756842787055
"""Root of x^7 = x + 1, whose powers fill six dimensions evenly (R-sequence)."""


@dataclass(frozen=True)
class StateSample:
    """Sampled states of frames, with the slopes of their exact PSFs.

    Attributes
    ----------
    states : PupilStates
    vergence_dpt : (P,)
        Vergence of the object, in the plane of the entrance pupil.
    pixel_from_mrad : (P, 2, 2) or None
        Local scale of the image, if frames map stored kernels to it.  None without a
        range of gaze: between the nodes around a pixel the scale changes so little that
        mapping a kernel causes as much error as it removes.
    exact_px : (P, n, 2)
        Slopes of the exact PSFs.
    """

    eye: EyeOptics
    spec: GridSpec
    states: PupilStates
    vergence_dpt: NDArray[np.float64]
    pixel_from_mrad: NDArray[np.float64] | None
    exact_px: NDArray[np.float64]

    @property
    def unit_px(self) -> NDArray[np.float64]:
        """Wavelength over pupil diameter (P,), px."""
        return unit_px(self.spec, self.states)

    def select(self, index: NDArray[np.int64]) -> "StateSample":
        """Return the states at the given indices."""
        return replace(
            self,
            states=self.states.select(index),
            vergence_dpt=self.vergence_dpt[index],
            pixel_from_mrad=(
                None if self.pixel_from_mrad is None else self.pixel_from_mrad[index]
            ),
            exact_px=self.exact_px[index],
        )


def unit_px(spec: GridSpec, states: PupilStates) -> NDArray[np.float64]:
    """Return wavelength over pupil diameter (P,) in pixels on the camera's axis."""
    unit_mrad = states.wavelength_nm / 1e3 / states.pupil_diameter_mm  # um/mm
    return unit_mrad / min(spec.pixel_pitch_mrad)


def sample_states(eye: EyeOptics, spec: GridSpec, count: int) -> StateSample:
    """Sample image positions, pupils, foci, object distances and channels evenly.

    Half of the objects are in focus, where interpolation errors are most visible.  The
    others are spread over the range of distances.
    """
    steps = 1.0 / _PLASTIC ** np.arange(1, 7)
    unit = (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0
    x, y, pupil, focus, distance, channel = unit.T
    h_deg, v_deg, scale = _image_directions(spec, x, y)
    low_mm, high_mm = (eye.usable_pupil_mm(p) for p in spec.settings.pupil_range_mm)
    foci_dpt = (
        spec.settings.focus_range_dpt[0] + np.ptp(spec.settings.focus_range_dpt) * focus
    )
    pupils_mm = low_mm + (high_mm - low_mm) * pupil
    first, number = distinct_rows(foci_dpt, pupils_mm)  # one, if no range is wide
    accommodations_dpt, focused_dpt = (
        np.array(
            [
                evaluate(focus_dpt, pupil_diameter_mm=pupil_mm)
                for focus_dpt, pupil_mm in zip(
                    foci_dpt[first], pupils_mm[first], strict=True
                )
            ]
        )[number]
        for evaluate in (eye.accommodation_dpt, eye.reachable_focus_dpt)
    )
    vergence_dpt = eye.vergence.vergence_dpt(
        np.where(
            distance < 0.5,
            _nearest_object_dpt(spec, focused_dpt),
            _objects_dpt(spec, np.maximum(2.0 * distance - 1.0, 0.0)),
        )
    )
    wavelengths_nm = spec.channel_wavelengths_nm
    known = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "pupil_diameter_mm": pupils_mm,
        "accommodation_dpt": accommodations_dpt,
        "wavelength_nm": wavelengths_nm[(channel * len(wavelengths_nm)).astype(int)],
    }
    states = PupilStates(
        **known, total_defocus_dpt=eye.total_defocus_dpt(**known) + vergence_dpt
    )
    pixel_from_mrad = scale if any(spec.settings.gaze_range_deg) else None
    exact_px = slopes_px(
        state_frames(eye, spec, states, pixel_from_mrad=pixel_from_mrad)
    )
    return StateSample(eye, spec, states, vergence_dpt, pixel_from_mrad, exact_px)


def _nearest_object_dpt(
    spec: GridSpec, focused_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the object distances (P,) nearest to the eye's focus."""
    ranges_dpt = np.array(spec.object_ranges_dpt)
    found = np.clip(focused_dpt[:, None], ranges_dpt[:, 0], ranges_dpt[:, 1])
    best = np.abs(found - focused_dpt[:, None]).argmin(axis=1)
    return found[np.arange(best.size), best]


def _objects_dpt(spec: GridSpec, share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the object distances (P,) at shares of the concatenated ranges."""
    ranges_dpt = np.array(spec.object_ranges_dpt)
    steps = share * len(ranges_dpt)
    number = np.minimum(steps.astype(int), len(ranges_dpt) - 1)
    low_dpt, high_dpt = ranges_dpt[number].T
    return low_dpt + (high_dpt - low_dpt) * (steps - number)


def _image_directions(
    spec: GridSpec, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return field directions (P,) and local scales at image positions from 0 to 1.

    Positions alternate between the gaze directions that frames may have.
    """
    if not spec.follows_field:
        zeros = np.zeros(x.size)
        return zeros, zeros, spec.pixel_from_mrad(zeros, zeros)
    camera, gazes = spec.camera, spec.gaze_samples_deg()
    h_deg, v_deg = np.empty(x.size), np.empty(x.size)
    scale = np.empty((x.size, 2, 2))
    for k, gaze_deg in enumerate(gazes):
        own = slice(k, None, len(gazes))
        h_deg[own], v_deg[own] = (
            np.clip(angle, -MAX_FIELD_DEG, MAX_FIELD_DEG)
            for angle in field_deg(
                camera,
                x[own] * camera.width_px,
                y[own] * camera.height_px,
                gaze_deg=gaze_deg,
            )
        )
        scale[own] = spec.pixel_from_mrad(h_deg[own], v_deg[own], gaze_deg=gaze_deg)
    return h_deg, v_deg, scale


def moved(sample: StateSample, axis: str, to: NDArray[np.float64]) -> PupilStates:
    """Return the states (P,) that frames read at other values of an axis.

    Field and accommodation are read at the same total defocus, the pupil at the same
    geometric blur, or with several foci at the same total defocus.  The paper's grids
    are read at the distance of the object.
    """
    columns = vars(sample.states) | {FIELD_OF_AXIS[axis]: to}
    total_dpt = columns.pop("total_defocus_dpt")
    if axis == "pupil":
        total_dpt = total_dpt * _blur_scale(sample, to)
    elif axis in ("h", "v") and not sample.spec.blends_at_equal_blur:
        total_dpt = sample.eye.total_defocus_dpt(**columns) + sample.vergence_dpt
    return PupilStates(**columns, total_defocus_dpt=total_dpt)


def _blur_scale(
    sample: StateSample, pupils_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the ratio (P,) of the defocus read at other pupils to the states' own."""
    if sample.eye.rings is not None:  # foci are the same in any pupil
        return np.ones(pupils_mm.shape)
    return sample.states.pupil_diameter_mm / pupils_mm


def axis_error(sample: StateSample, axis: str, nodes: NDArray[np.float64]) -> float:
    """Return the mean square error of interpolating one axis between nodes."""
    return axis_errors(sample, axis, [nodes])[0]


def axis_errors(
    sample: StateSample, axis: str, choices: list[NDArray[np.float64]]
) -> list[float]:
    """Return `axis_error` of several choices of nodes with one call of the eye."""
    found = [
        bracket_axis(nodes, vars(sample.states)[FIELD_OF_AXIS[axis]])
        for nodes in choices
    ]
    ends = [nodes[low] for nodes, (low, _, _) in zip(choices, found, strict=True)]
    ends += [nodes[high] for nodes, (_, high, _) in zip(choices, found, strict=True)]
    count = sample.vergence_dpt.size
    repeated = sample.select(np.tile(np.arange(count), 2 * len(choices)))
    neighbors = moved(repeated, axis, np.concatenate(ends))
    own = sample.select(np.tile(np.arange(count), len(choices)))
    share = np.concatenate([share for _, _, share in found])
    errors = _square_errors(own, neighbors, share).reshape(len(choices), count)
    return (AXIS_FACTOR[axis] * errors.mean(axis=1)).tolist()


def defocus_error(sample: StateSample, plan: CachePlan) -> float:
    """Return the mean square error of interpolating defocus within groups.

    Each state reads the group of its nearest nodes of field, pupil and accommodation.
    """
    states = sample.states
    corner = [
        np.abs(nodes - values[:, None]).argmin(axis=1)
        for nodes, values in (
            (plan.pupils_mm, states.pupil_diameter_mm),
            (plan.accommodations_dpt, states.accommodation_dpt),
            (plan.v_deg, states.v_deg),
            (plan.h_deg, states.h_deg),
        )
    ]
    groups = np.ravel_multi_index(corner, plan.group_shape)
    own_dpt = np.zeros(states.h_deg.size)
    if not sample.spec.blends_at_equal_blur:  # a group covers distances at its own node
        node = PupilStates(
            **vars(states)
            | {"h_deg": plan.h_deg[corner[3]], "v_deg": plan.v_deg[corner[2]]}
        )
        own_dpt += sample.vergence_dpt - states.total_defocus_dpt
        own_dpt += _at_infinity_dpt(sample, node)
    channel = np.argmin(
        np.abs(sample.spec.channel_wavelengths_nm - states.wavelength_nm[:, None]),
        axis=1,
    )
    shift_dpt = plan.nodes.channel_shift_dpt[groups, channel]
    scale = _blur_scale(sample, plan.pupils_mm[corner[0]])
    read_dpt = (states.total_defocus_dpt + own_dpt) * scale - shift_dpt
    defocus = plan.nodes.defocus
    lower, upper, share = defocus.bracket(groups, read_dpt)
    columns = vars(states.select(np.tile(np.arange(share.size), 2)))
    columns["total_defocus_dpt"] = np.concatenate(
        [
            (defocus.values_dpt[index] + shift_dpt) / scale - own_dpt
            for index in (lower, upper)
        ]
    )
    return AXIS_FACTOR["defocus"] * _error(sample, PupilStates(**columns), share)


def _at_infinity_dpt(sample: StateSample, states: PupilStates) -> NDArray[np.float64]:
    columns = dict(vars(states))
    del columns["total_defocus_dpt"]
    return sample.eye.total_defocus_dpt(**columns)


def _error(
    sample: StateSample, neighbors: PupilStates, share: NDArray[np.float64]
) -> float:
    """Return the mean square error of `_square_errors`."""
    return float(_square_errors(sample, neighbors, share).mean())


def _square_errors(
    sample: StateSample, neighbors: PupilStates, share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the square errors (P,) of blending neighbors.

    Parameters
    ----------
    neighbors : PupilStates
        Lower neighbors (P,), followed by the upper ones (P,).
    share : (P,)
        Share of the upper neighbor.
    """
    found = np.zeros(share.size)
    for light_ratio, added_dpt in focus_light(sample):
        lower_px, upper_px = np.split(
            focus_slopes_px(sample, neighbors, np.tile(added_dpt, 2)), 2
        )
        found += light_ratio**2 * blend_error(
            lower_px,
            upper_px,
            sample.exact_px
            if sample.eye.rings is None
            else focus_slopes_px(sample, sample.states, added_dpt),
            share_ratio=share,
            unit_px=sample.unit_px,
        )
    return found


def focus_light(
    sample: StateSample,
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the share of light (P,) and the power (P,), dpt, of each focus of an eye.

    The error of each focus is weighted by its light, as an amplitude: where one focus
    is sharp, the others contribute little.
    """
    states, rings = sample.states, sample.eye.rings
    if rings is None:
        return [(np.ones(states.h_deg.size), np.zeros(states.h_deg.size))]
    found: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for wavelength_nm in np.unique(states.wavelength_nm).tolist():
        own = np.flatnonzero(states.wavelength_nm == wavelength_nm)
        radius_mm = states.pupil_diameter_mm[own] / 2.0
        ratios = rings.main_light_ratio(radius_mm, wavelength_nm)
        for k, added_dpt in enumerate(rings.main_dpt(wavelength_nm).tolist()):
            if k == len(found):
                found.append((np.zeros(states.h_deg.size), np.zeros(states.h_deg.size)))
            found[k][0][own], found[k][1][own] = ratios[k], added_dpt
    return found


def focus_slopes_px(
    sample: StateSample, states: PupilStates, added_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return slopes (m P, n, 2), px, of the light of a focus in the sample's pixels."""
    count = states.h_deg.size // sample.states.h_deg.size
    scale = sample.pixel_from_mrad
    if scale is not None:
        scale = np.tile(scale, (count, 1, 1))
    total_dpt = states.total_defocus_dpt - added_dpt
    columns = vars(states) | {"total_defocus_dpt": total_dpt}
    return slopes_px(
        state_frames(
            sample.eye, sample.spec, PupilStates(**columns), pixel_from_mrad=scale
        )
    )
