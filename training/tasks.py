"""Domains and tasks: the columns, ranges and labels of each network.

A *domain* is a set of input columns with ranges, and the ray tracing that labels them.
A *task* is a network, whose columns are those of a domain. Ranges are those of the
paper's Table 2. Labels are traced on the CPU in float64, by the tracer of the service.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import (
    AQUEOUS,
    DIAMETER,
    pack_eyes,
    resized_eyes,
    smallest_diameter_mm,
)
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters, sampled_ranges
from estimator.eye.tracing import MEDIA_INWARDS, TraceFailed, eye_indices
from estimator.networks.inference import INPUTS, OUTPUTS
from estimator.networks.inference import ZERNIKE_NAMES as ZERNIKE_NAMES
from estimator.optics.media import refractive_index
from estimator.optics.prescription import C20
from estimator.optics.raytrace import RayStatus
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.wavefront.aberrations import eyes_aberrations, on_axis_zernike
from estimator.wavefront.compiled import magnifications

N_EYE = len(PARAMETER_NAMES)
COMPARED_NAMES = ZERNIKE_NAMES[2:]
"""Compared coefficients, without tilt, which the zero slope of the chief ray determines
from coma."""

FOCUS_RANGE_DPT = (-6.0, 16.0)
"""The paper's range is 0.125 to 8.125. A hyperopic eye that accommodates less than its
refraction has a negative focus; the far point of a -10 dpt myope is at 10 dpt."""

LENS_DIAMETER_MARGINS = np.array([[1.02], [0.99]])
"""Factors of the largest and smallest lens diameter in the training data, which extends
beyond the range to which outputs are clamped."""

MAX_COEFFICIENT_UM = 200.0
"""Larger coefficients are those of eyes that form no image; the published data end at
115 um."""

N_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2

Labels = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Domain:
    """Input columns with ranges, and their labels.

    Attributes
    ----------
    inputs, targets : tuple of str
        Column names; the first 45 inputs are the eye.
    ranges : (n_inputs, 2)
    label : callable
        Maps inputs (n, n_inputs) to targets (n, n_targets); vignetted rows are nan.
    n_repeats : int
        Number of values of the last input per eye: 1, or the length of a Cartesian
        product.
    is_focused : bool
        Eyes may be accommodated.
    """

    name: str
    inputs: tuple[str, ...]
    ranges: NDArray[np.float64]
    targets: tuple[str, ...]
    label: Labels
    n_repeats: int = 1
    is_focused: bool = False


def media_indices_of(wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return refractive indices (n, 5), one wavelength per row."""
    media = [refractive_index(medium, wavelength_nm) for medium in MEDIA_INWARDS]
    return np.stack(np.broadcast_arrays(*media), axis=-1)


def label_on_axis(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients (n, 27), um, on the filled circle of the pupil."""
    return _whole_circles(inputs[:, :N_EYE], inputs[:, -2], inputs[:, -1])[:, 1:]


def _whole_circles(
    eyes: NDArray[np.float64],
    pupil_mm: NDArray[np.float64],
    wavelength_nm: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return coefficients (n, 28), um; nan for an eye that is partly vignetted."""
    zernike_um, status_index = on_axis_zernike(
        pack_eyes(eyes),
        media_indices_of(wavelength_nm),
        zernike_radius_mm=pupil_mm / 2.0,
        n_threads=N_CORES,
    )
    zernike_um[status_index != RayStatus.TRACED] = np.nan
    return zernike_um


def label_field(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients (n, 27), um, of whole off-axis pupils, and rims (n, 6)."""
    packed = pack_eyes(inputs[:, :N_EYE])
    pupil_mm, wavelength_nm, h_deg, v_deg = inputs[:, N_EYE:].T
    ratios = magnifications(packed, eye_indices(REFERENCE_WAVELENGTH_NM))
    usable = ratios > 0.0
    found = eyes_aberrations(
        packed,
        media_indices_of(wavelength_nm),
        stop_diameters_mm=np.where(usable, pupil_mm / ratios, 1.0),
        h_deg=h_deg,
        v_deg=v_deg,
        n_threads=N_CORES,
    )
    targets = np.concatenate(
        [
            found.zernike_um[:, 1:],
            found.zernike_radius_mm[:, None],
            ellipse_matrix(found.ellipse_mm),
        ],
        axis=1,
    )
    # The rim of a vignetted pupil has kinks, which a smooth function cannot fit.
    targets[~usable | (found.open_ratio < 1.0 - 1e-9)] = np.nan
    return targets


def ellipse_matrix(ellipse_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return center and symmetric matrix (n, 5): x, y, xx, xy, yy.

    From `wavefront.FieldResults.ellipse_mm` (n, 5): center, semi-axes, angle (rad).
    Unlike these, the matrix is smooth at equal axes.
    """
    x, y, major, minor, angle_rad = ellipse_mm.T
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack(
        [
            x,
            y,
            major * cosine**2 + minor * sine**2,
            (major - minor) * cosine * sine,
            major * sine**2 + minor * cosine**2,
        ],
        axis=-1,
    )


def label_focus(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return changes (n, 2), mm, of lens diameter and aqueous thickness at each focus.

    Rows of one eye and pupil must be consecutive.
    """
    eyes = inputs[:, : N_EYE + 1]
    starts = np.flatnonzero(np.r_[True, np.any(eyes[1:] != eyes[:-1], axis=1)])
    parts = []
    for start, stop in zip(starts, np.r_[starts[1:], len(inputs)], strict=True):
        parts.append(_focus_of_one(eyes[start], inputs[start:stop, -1]))
    return np.concatenate(parts)


def _focus_of_one(
    eye_and_pupil: NDArray[np.float64], focuses_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    try:
        eye = AccommodatingEye(
            EyeParameters.from_vector(eye_and_pupil[:N_EYE]),
            pupil_diameter_mm=float(eye_and_pupil[N_EYE]),
            keeps_conics=True,
        )
    except TraceFailed:
        return np.full((len(focuses_dpt), 2), np.nan)
    # The network uses the refraction at the cornea.
    return eye.changes_mm(eye.accommodations_at_cornea_dpt(-focuses_dpt))


def label_lens(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return focus (dpt) and changes (mm) of eyes with a shrunken lens: targets (n, 3).

    This is the inverse of `label_focus`. It takes one trace per row instead of a
    search, so every row can have a different eye.
    """
    eyes, pupil_mm, share = inputs[:, :N_EYE], inputs[:, N_EYE], inputs[:, -1]
    relaxed_mm = eyes[:, DIAMETER]
    widest_mm, least_mm = LENS_DIAMETER_MARGINS * np.stack(
        [relaxed_mm, smallest_diameter_mm(eyes)]
    )
    focused = resized_eyes(eyes, widest_mm + share * (least_mm - widest_mm))
    color_nm = np.full(len(eyes), REFERENCE_WAVELENGTH_NM)
    zernike_um = _whole_circles(focused, pupil_mm, color_nm)
    focus_dpt = SPHERE_PER_C20 * zernike_um[:, C20] / (pupil_mm / 2.0) ** 2
    changes_mm = (focused - eyes)[:, [DIAMETER, AQUEOUS]]
    return np.column_stack([focus_dpt, changes_mm])


def _ranges(
    *others: tuple[float, float], lens_mm: tuple[float, float] | None = None
) -> NDArray[np.float64]:
    eye = sampled_ranges()
    if lens_mm is not None:
        eye[PARAMETER_NAMES.index("lens_diameter_mm")] = lens_mm
    return np.concatenate([eye, np.array(others)])


DOMAINS = {
    domain.name: domain
    for domain in (
        Domain(
            "on_axis",
            INPUTS["discriminator"],
            _ranges((3.0, 6.0), (450.0, 900.0)),
            ZERNIKE_NAMES,
            label_on_axis,
        ),
        Domain(
            "field",
            INPUTS["aberration"],
            _ranges(
                (2.0, 7.0),
                (450.0, 700.0),
                (-45.0, 45.0),
                (-26.0, 26.0),
                lens_mm=(8.4, 9.75),  # accommodated lenses, too
            ),
            OUTPUTS["aberration"],
            label_field,
            is_focused=True,
        ),
        Domain(
            "focus",
            INPUTS["focus"],
            _ranges((2.0, 7.0), FOCUS_RANGE_DPT),
            OUTPUTS["focus"],
            label_focus,
            n_repeats=10,
        ),
        Domain(
            "lens",
            (*PARAMETER_NAMES, "pupil_diameter_mm", "lens_shrinkage_ratio"),
            _ranges((2.0, 7.0), (0.0, 1.0)),
            ("focus_dpt", *OUTPUTS["focus"]),
            label_lens,
        ),
    )
}


@dataclass(frozen=True)
class Task:
    """A network: input columns, output columns, and the source of its rows.

    Attributes
    ----------
    domain : Domain
        Domain of its training data.
    evaluation_domain : Domain
        Domain of its evaluation.
    unit : str
        Unit of that error.
    """

    name: str
    domain: Domain
    evaluation_domain: Domain
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    unit: str


TASKS = {
    name: Task(
        name, DOMAINS[trained], DOMAINS[evaluated], INPUTS[name], OUTPUTS[name], unit
    )
    for name, trained, evaluated, unit in (
        ("discriminator", "on_axis", "on_axis", "um"),
        ("eye", "on_axis", "on_axis", "um"),
        ("focus", "lens", "focus", "mm"),
        ("aberration", "field", "field", "um"),
    )
}
"""The four networks of the paper (Table 1). The aberration estimator also returns the
circle of its coefficients. The focused-eye estimator is trained on lenses and their
focus, and evaluated on the lens that a focus requires."""
