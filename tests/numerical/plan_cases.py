"""Interpolated against exact kernels for the planner's tests and benchmarks.

`sampled_errors` reads a plan as a frame does: three field nodes, three nodes of pupil
and accommodation and two of defocus each, every kernel computed, none from a store.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from estimator.estimate.estimation import estimate_eye
from estimator.field.traced_eye import TracedEye
from estimator.profiles.files import load_profile
from estimator.psf.compute import compute_psf_batch
from filter_service.planning.defocus_nodes import DISTANCES_DPT
from filter_service.planning.grid import pupil_nodes_mm
from filter_service.planning.node_wavefronts import PupilStates
from filter_service.planning.nodes import bracket_axis
from filter_service.planning.state_samples import FIELD_OF_AXIS, sample_states
from filter_service.psfs.pack import pack_kernels
from tests.grid_specs import grid_spec
from tests.reference.packed_kernels import square_kernel

SPECTRUM_SIDE_PX = 256

COURTYARD_SPECTRUM = (
    (0.025, 0.04, 0.063, 0.1, 0.16, 0.25, 0.4, 0.63, 1.0, 1.58, 2.5),
    (70.0, 35.0, 15.3, 5.25, 2.04, 0.943, 0.269, 0.085, 0.0265, 0.00668, 0.00137),
)
"""Measured variance of a pixel per frequency (rad/px) in linear 720p frames of
*Courtyard*; its mean over all frequencies is 0.037."""


def spec_for(width_px=480, height_px=270, vertical_fov_deg=50.0, **settings):
    up = math.tan(math.radians(vertical_fov_deg) / 2)
    right = up * width_px / height_px
    return grid_spec(
        width_px=width_px,
        height_px=height_px,
        tangents=(-right, right, up, -up),
        **settings,
    )


def traced_eye(name, spec, periphery="people"):
    """The traced eye of a preset for all that a spec asks for."""
    return _traced(
        name,
        periphery,
        tuple(pupil_nodes_mm(spec.settings.pupil_range_mm)),
        spec.settings.focus_range_dpt,
        spec.field_range_deg,
        tuple(spec.traced_wavelengths_nm),
    )


@cache
def _estimated(name, periphery):
    return estimate_eye(replace(load_profile(name), periphery=periphery))


@cache
def _traced(
    name, periphery, pupils_mm, focus_range_dpt, field_range_deg, wavelengths_nm
):
    return TracedEye.trace(
        _estimated(name, periphery),
        pupil_diameters_mm=pupils_mm,
        focus_range_dpt=focus_range_dpt,
        wavelengths_nm=wavelengths_nm,
        field_range_deg=field_range_deg,
    )


@cache
def isotropic_spectrum(side_px=SPECTRUM_SIDE_PX, table=COURTYARD_SPECTRUM):
    """Spectrum (side, side) as `numpy.fft.fft2` orders it."""
    along = 2.0 * math.pi * np.fft.fftfreq(side_px)
    frequency = np.maximum(np.hypot(along[:, None], along), table[0][0])
    return np.exp(np.interp(np.log(frequency), *np.log(table)))


def image_error(kernel_difference, spectrum=None):
    """Mean square of an image of that spectrum, filtered with a difference kernel.

    Where it is None, `isotropic_spectrum` as large as the kernel needs.
    """
    rows, columns = kernel_difference.shape
    if spectrum is None:
        spectrum = isotropic_spectrum(
            SPECTRUM_SIDE_PX * 2 ** math.ceil(math.log2(max(rows / 200.0, 1.0)))
        )
    side = len(spectrum)
    if max(rows, columns) > side:
        raise ValueError(f"kernel of {rows} px: the spectrum has {side}")
    padded = np.zeros((side, side))
    padded[:rows, :columns] = kernel_difference
    return float(np.mean(np.abs(np.fft.fft2(padded)) ** 2 * spectrum))


def exact_kernels(eye, spec, states):
    """Kernels of states (P,) as they are computed, untrimmed."""
    found = eye.wavefronts(**vars(states))
    return compute_psf_batch(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        wavelength_nm=states.wavelength_nm,
        pixel_from_mrad=spec.pixel_from_mrad(states.h_deg, states.v_deg),
        diffraction=spec.settings.diffraction,
        pupil_screen=eye.rings and eye.rings.seen_from(states.h_deg, states.v_deg),
        min_energy_ratio=1.0 - 0.2 * (1.0 - spec.kept_energy_ratio),
        workers=2,
    )


@dataclass(frozen=True)
class _Corners:
    """Nodes that states (P,) read, and their weights, corner by corner (P, 18)."""

    states: PupilStates
    weights: np.ndarray


def blur_scale(eye, states, pupil_mm):
    """Defocus at which a pupil is read, over that of states; several foci stay."""
    if eye.rings is not None:
        return 1.0
    return states.pupil_diameter_mm / pupil_mm


def _triangle(first, second):
    """Corners of triangles: index and value on two axes, and the weight.

    Parameters
    ----------
    first, second : (lower, upper) indices, (lower, upper) values, share
    """
    (i, a, s), (j, b, t) = first, second
    larger = np.where(s >= t, (i[1], j[0]), (i[0], j[1]))
    values = np.where(s >= t, (a[1], b[0]), (a[0], b[1]))
    low, high = np.minimum(s, t), np.maximum(s, t)
    return [
        ((i[0], a[0]), (j[0], b[0]), 1.0 - high),
        ((larger[0], values[0]), (larger[1], values[1]), high - low),
        ((i[1], a[1]), (j[1], b[1]), low),
    ]


def plan_corners(eye, spec, plan, states, object_dpt, axes):
    """Read all axes of a plan, or only some and the others exactly."""
    count = states.h_deg.size

    def ends(axis, nodes):
        values = vars(states)[FIELD_OF_AXIS[axis]]
        if axis not in axes:
            none = np.zeros(count, np.int64)
            return (none, none), (values, values), np.zeros(count)
        lower, upper, share = bracket_axis(nodes, values)
        return (lower, upper), (nodes[lower], nodes[upper]), share

    h, v = ends("h", plan.h_deg), ends("v", plan.v_deg)
    middle = (h[1][0] + h[1][1]) * (v[1][0] + v[1][1])
    is_turned = middle >= 0.0
    h = (
        *(tuple(np.where(is_turned, pair[::-1], pair)) for pair in h[:2]),
        np.where(is_turned, 1.0 - h[2], h[2]),
    )
    fields = _triangle(h, v)
    inner = _triangle(
        ends("pupil", plan.pupils_mm), ends("accommodation", plan.accommodations_dpt)
    )
    channel = np.argmin(
        np.abs(spec.channel_wavelengths_nm - states.wavelength_nm[:, None]), axis=1
    )
    found, weights = [], []
    for (h_index, h_deg), (v_index, v_deg), field_share in fields:
        total_dpt = object_dpt + eye.total_defocus_dpt(
            h_deg=h_deg,
            v_deg=v_deg,
            pupil_diameter_mm=states.pupil_diameter_mm,
            accommodation_dpt=states.accommodation_dpt,
            wavelength_nm=states.wavelength_nm,
        )
        for (pupil_index, pupil_mm), (used_index, used_dpt), inner_share in inner:
            at_dpt = total_dpt * blur_scale(eye, states, pupil_mm)
            share = field_share * inner_share
            columns = {
                "h_deg": h_deg,
                "v_deg": v_deg,
                "pupil_diameter_mm": pupil_mm,
                "accommodation_dpt": used_dpt,
                "wavelength_nm": states.wavelength_nm,
            }
            if "defocus" not in axes:
                found.append(columns | {"total_defocus_dpt": at_dpt})
                weights.append(share)
                continue
            group = np.ravel_multi_index(
                (pupil_index, used_index, v_index, h_index), plan.group_shape
            )
            shift_dpt = plan.nodes.channel_shift_dpt[group, channel]
            defocus = plan.nodes.defocus
            lower, upper, part = defocus.bracket(group, at_dpt - shift_dpt)
            for index, t_share in ((lower, 1 - part), (upper, part)):
                node_dpt = defocus.values_dpt[index] + shift_dpt
                found.append(columns | {"total_defocus_dpt": node_dpt})
                weights.append(share * t_share)
    return _Corners(
        PupilStates(
            **{
                name: np.stack([np.broadcast_to(c[name], count) for c in found], axis=1)
                for name in found[0]
            }
        ),
        np.stack(weights, axis=1),
    )


ALL_AXES = ("h", "v", "pupil", "accommodation", "defocus")


def sampled_errors(
    eye,
    spec,
    plan,
    *,
    count,
    seed=0,
    axes=ALL_AXES,
    spectrum=None,
    sample_count=4096,
):
    """Mean square errors (count,) of images at random states, blended against exact.

    Parameters
    ----------
    axes : tuple
        Which axes are interpolated: with "defocus" all must be; the others alone or
        together.
    sample_count : int
        States that the random ones are chosen from.
    """
    sample = sample_states(eye, spec, sample_count)
    chosen = np.random.default_rng(seed).choice(sample_count, count, replace=False)
    sample = sample.select(chosen)
    return state_errors(
        eye,
        spec,
        plan,
        sample.states,
        sample.vergence_dpt,
        axes=axes,
        spectrum=spectrum,
    )


def state_errors(
    eye, spec, plan, states, object_dpt, *, axes=ALL_AXES, spectrum, stored=False
):
    """Mean square errors (P,) of images at given states, blended against exact.

    ``stored``: blend kernels as a cache holds them, trimmed and in 16 bits.
    """
    corners = plan_corners(eye, spec, plan, states, object_dpt, axes)
    kept = corners.weights > 1e-9
    exact = exact_kernels(eye, spec, states)
    blended = exact_kernels(
        eye,
        spec,
        PupilStates(**{name: v[kept] for name, v in vars(corners.states).items()}),
    )
    kernels = _stored(spec, blended) if stored else [psf.kernel for psf in blended]
    starts = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
    return np.array(
        [
            image_error(
                _difference(
                    exact[k].kernel,
                    kernels[starts[k] : starts[k + 1]],
                    corners.weights[k][kept[k]],
                ),
                spectrum,
            )
            for k in range(len(exact))
        ]
    )


def _difference(exact, kernels, weights):
    side = max(kernel.shape[0] for kernel in (exact, *kernels))
    difference = np.zeros((side, side))
    for weight, kernel in zip((1.0, *-weights), (exact, *kernels), strict=True):
        edge = (side - kernel.shape[0]) // 2
        inner = slice(edge, side - edge)
        difference[inner, inner] += weight * kernel / kernel.sum(dtype=np.float64)
    return difference


def _stored(spec, batch):
    packed = pack_kernels(batch, kept_energy_ratio=spec.kept_energy_ratio)
    return [
        square_kernel(packed.weights, int(offset), reach_px, int(reach_px.max()))
        for offset, reach_px in zip(packed.offsets, packed.reach_px, strict=True)
    ]


def node_errors(eye, spec, plan, *, count, seed=0):
    """Errors (count,) at nodes, where only storage errs."""
    rng = np.random.default_rng(seed)

    def drawn(nodes):
        if len(nodes) == 1:
            return np.full(count, nodes[0])
        return nodes[rng.integers(0, len(nodes) - 1, count)]

    # A node of the defocus groups is one distance, in green, at all of the paper's.
    n_distances = int(plan.nodes.defocus.counts[0])
    object_dpt = drawn(np.linspace(*DISTANCES_DPT, n_distances))
    wavelengths_nm = spec.channel_wavelengths_nm
    known = {
        "h_deg": drawn(plan.h_deg),
        "v_deg": drawn(plan.v_deg),
        "pupil_diameter_mm": drawn(plan.pupils_mm),
        "accommodation_dpt": drawn(plan.accommodations_dpt),
        "wavelength_nm": wavelengths_nm[rng.integers(0, 3, count)],
    }
    states = PupilStates(
        **known, total_defocus_dpt=eye.total_defocus_dpt(**known) + object_dpt
    )
    return state_errors(
        eye,
        spec,
        plan,
        states,
        object_dpt,
        spectrum=None,
        stored=True,
    )


def mean_db(errors):
    return -10.0 * math.log10(float(np.mean(errors)))
