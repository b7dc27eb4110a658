"""Labels computed as in the published data sets, for a comparison of statistics.

The authors' framework (see its published sources and `compat_lens_shape`)
differs from this one: circles have the size of the stop, the lens has another shape
rule, two offset terms receive the values of others, one conic constant has a narrower
range, and off axis, a stretch multiplies slopes that it should divide. Training does
not use this module.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import OFFSET_SLICE, EyeParameters, column
from estimator.optics.surfaces import pack_eye
from estimator.optics.zernike import N_TERMS, zernike_gradient
from estimator.wavefront.aberrations import eyes_aberrations
from estimator.wavefront.compiled import FieldResults
from training.tasks import N_EYE, media_indices_of

CIRCLE, LENS, SLIP, STRETCH = (
    "pupil is the stop",
    "their lens rule",
    "two offsets mis-wired",
    "slopes times the stretch",
)
ON_AXIS_STEPS = (CIRCLE, LENS, SLIP)
FIELD_STEPS = (CIRCLE, LENS, SLIP, STRETCH)

SMALLEST_DIAMETER_RATIO = 0.91
N_RINGS, N_AZIMUTHS = 8, 24


def narrow_posterior_conic(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map the posterior cornea's conic from -1.5 ... -0.01 to -1 ... -0.01."""
    name = column("cornea_posterior_conic_constant")
    narrow = inputs.copy()
    narrow[:, name] = -0.01 + (inputs[:, name] + 0.01) * (0.99 / 1.49)
    return narrow


def _miswired(eyes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give offset (4, 0) the value of (4, -2), and (4, 2) that of (2, -2)."""
    wrong = eyes.copy()
    first = OFFSET_SLICE.start - 1  # of j = 0
    wrong[:, first + 12] = eyes[:, first + 11]
    wrong[:, first + 13] = eyes[:, first + 3]
    return wrong


def _packed(eyes: NDArray[np.float64], steps: Sequence[str]) -> NDArray[np.float64]:
    if SLIP in steps:
        eyes = _miswired(eyes)
    rule = "compat" if LENS in steps else "C"
    return np.stack(
        [
            pack_eye(eye_surfaces(EyeParameters.from_vector(eye), lens_rule=rule))
            for eye in eyes
        ]
    )


def _traced(inputs: NDArray[np.float64], steps: Sequence[str]) -> FieldResults:
    fields_deg = inputs[:, N_EYE + 2 :]
    h_deg, v_deg = fields_deg.T if fields_deg.size else (0.0, 0.0)
    return eyes_aberrations(
        _packed(inputs[:, :N_EYE], steps),
        media_indices_of(inputs[:, N_EYE + 1]),
        stop_diameters_mm=inputs[:, N_EYE],
        h_deg=h_deg,
        v_deg=v_deg,
    )


def label_on_axis_as_published(
    inputs: NDArray[np.float64], steps: Sequence[str]
) -> NDArray[np.float64]:
    """Return coefficients (n, 27), um, with the properties ``steps``."""
    return _traced(inputs, steps).zernike_um[:, 1:]


def label_field_as_published(
    inputs: NDArray[np.float64], steps: Sequence[str]
) -> NDArray[np.float64]:
    """Return coefficients and zero rims (n, 33), with the properties ``steps``."""
    found = _traced(inputs, steps)
    zernike_um = found.zernike_um
    if STRETCH in steps:
        zernike_um = np.stack(
            [
                stretched(terms, radius_mm, ellipse_mm)
                for terms, radius_mm, ellipse_mm in zip(
                    zernike_um, found.zernike_radius_mm, found.ellipse_mm, strict=True
                )
            ]
        )
    open_pupil = found.open_ratio >= 1.0 - 1e-9
    targets = np.where(open_pupil[:, None], zernike_um[:, 1:], np.nan)
    return np.column_stack([targets, np.zeros((len(targets), 6))])


def stretched(
    zernike_um: NDArray[np.float64], radius_mm: float, ellipse_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return coefficients (28,) after the published stretch to the major circle.

    It stretches points and transverse ray errors along the minor axis, which multiplies
    slopes by the ratio of the axes; in stretched coordinates they should be divided by
    it.
    """
    if not np.all(np.isfinite(zernike_um)):
        return zernike_um
    x_mm, y_mm, major_mm, minor_mm, angle_rad = ellipse_mm
    ring = np.sqrt((np.arange(N_RINGS) + 0.5) / N_RINGS)
    azimuth = 2.0 * np.pi * np.arange(N_AZIMUTHS) / N_AZIMUTHS
    u = (ring[:, None] * np.cos(azimuth)).ravel()
    v = (ring[:, None] * np.sin(azimuth)).ravel()
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)

    def turned(
        along: NDArray[np.float64], across: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return along * cosine - across * sine, along * sine + across * cosine

    px, py = turned(major_mm * u, minor_mm * v)
    slopes = zernike_gradient((x_mm + px) / radius_mm, (y_mm + py) / radius_mm)
    gx, gy = (slopes @ zernike_um / radius_mm).T
    along, across = gx * cosine + gy * sine, gy * cosine - gx * sine
    gx, gy = turned(along, across * (major_mm / minor_mm))
    basis = zernike_gradient(*turned(u, v))[..., 1:].reshape(-1, N_TERMS - 1)
    wanted = np.stack([gx, gy], axis=-1).ravel() * major_mm
    fitted = np.zeros(N_TERMS)
    fitted[1:] = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    return fitted


def lens_search_as_published(
    inputs: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Bound the changes (n, 2) of the lens: 9 % of its diameter at most.

    The aqueous changes in proportion, which is nearly correct.
    """
    lens_mm = inputs[:, column("lens_diameter_mm")]
    lowest_mm = (SMALLEST_DIAMETER_RATIO - 1.0) * lens_mm
    shrink = targets[:, 0]
    ratio = np.where(shrink < lowest_mm, lowest_mm / np.minimum(shrink, -1e-12), 1.0)
    return targets * ratio[:, None]
