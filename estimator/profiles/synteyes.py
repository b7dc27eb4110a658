"""Eyes drawn from SyntEyes, a statistical model of the biometry of healthy eyes.

SyntEyes (Rozema, Rodriguez, Navarro & Tassignon, IOVS 57:683, 2016) is a mixture of two
normal distributions of 18 parameters: the lengths of the eye, the radii and the power
of the lens, and 12 coefficients of principal components, which give both surfaces and
the thickness of the cornea.  It was fitted to 312 right eyes.  Refraction is not among
the parameters: it follows from them.  The retina is an ellipsoid, whose semi-axes are
drawn given the axial length.

An eye is traced as it is.  Its retina is at the axial length: traced through 5 mm, the
mean M of drawn eyes is then the mean of wavefronts that the same laboratory measured
(-0.86 dpt, 330 eyes; Rozema et al., Optom Vis Sci 94:680, 2017).  0.2 mm in front of
it, as in visisipy, eyes would be 0.55 dpt more hyperopic.

The lens has homogeneous index, which follows from its power, and mean higher orders,
which are part of the model: an offset of the anterior surface, in mm, on a circle of
5.5 mm.  The seventh and eighth order of the cornea are left out.
"""

import json
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.surface_eye import SurfaceModel
from estimator.note import Note
from estimator.optics.forms import TwoConics
from estimator.optics.media import OCULAR_MEDIA, OcularHerzberger
from estimator.optics.surfaces import EyeSurfaces, Retina, Surface
from estimator.optics.units import MM_PER_M, REFERENCE_WAVELENGTH_NM, UM_PER_MM
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    index_from_nm,
    norms,
    padded_terms,
    zernike_values,
)
from estimator.profiles.eye_profile import EyeProfile

SYNTEYES_FILE = Path(__file__).parent / "synteyes.json"

BIOMETRY_STREAM = 2
"""Second seed of drawn biometry; `typical_aberrations` and `periphery.change` have
others."""

CORNEA_RADIUS_MM, LENS_RADIUS_MM = 3.25, 2.75
"""Radii of the circles of the terms of the cornea and of the lens."""

LENS_CONICS = (-3.1316, -1.0)
"""Conic constants of the anterior and the posterior surface of the lens."""

CORNEA_INDEX, HUMOR_INDEX = 1.376, 1.336
"""Refractive indices of the cornea, and of aqueous and vitreous, at 555 nm."""

RETINA_THICKNESS_MM = 0.2
"""Part of the axial length behind the ellipsoid whose semi-axes are known."""

KERATOMETER_INDEX, KERATOMETER_RADIUS_MM = 1.3375, 1.5


@dataclass(frozen=True)
class Biometry:
    """Biometry of an eye: a right one, as seen by someone who faces the person.

    Attributes
    ----------
    cornea_thickness_mm, aqueous_depth_mm, lens_thickness_mm : float
        Along the axis; the aqueous lies between cornea and lens.
    axial_length_mm : float
        From the anterior cornea to the retina.
    lens_anterior_radius_mm, lens_posterior_radius_mm : float
        The posterior radius is negative.
    lens_power_dpt : float
        Equivalent power, in aqueous and vitreous.
    cornea_anterior_mm, cornea_posterior_mm : (28,)
        Sags of the surfaces of the cornea: Zernike coefficients of OSA order and
        normalization on a circle of 6.5 mm, each from its own apex.
    retina_semi_axes_mm : (x, y, z)
        Semi-axes of the retina's ellipsoid.
    """

    cornea_thickness_mm: float
    aqueous_depth_mm: float
    lens_thickness_mm: float
    axial_length_mm: float
    lens_anterior_radius_mm: float
    lens_posterior_radius_mm: float
    lens_power_dpt: float
    cornea_anterior_mm: NDArray[np.float64]
    cornea_posterior_mm: NDArray[np.float64]
    retina_semi_axes_mm: tuple[float, float, float]

    @property
    def lens_index(self) -> float:
        """Return the index of a homogeneous lens with this power, shape and thickness.

        The thick-lens equation is quadratic in the index; the larger root is the lens.
        """
        anterior = 1.0 / self.lens_anterior_radius_mm
        posterior = 1.0 / self.lens_posterior_radius_mm
        product = self.lens_thickness_mm * anterior * posterior
        outside, power = HUMOR_INDEX, self.lens_power_dpt / MM_PER_M
        square = anterior - posterior + product
        linear = -outside * (anterior - posterior) - 2.0 * outside * product - power
        root = math.sqrt(linear**2 - 4.0 * square * product * outside**2)
        return (root - linear) / (2.0 * square)

    @property
    def keratometry_dpt(self) -> float:
        """Return the mean power that a keratometer reads on a ring of 3 mm."""
        ring = np.array([0.0, KERATOMETER_RADIUS_MM / CORNEA_RADIUS_MM])
        # the mean over the ring has the terms without azimuth
        mean_mm = np.zeros(N_TERMS)
        for n in (0, 2, 4, 6):
            mean_mm[index_from_nm(n, 0)] = self.cornea_anterior_mm[index_from_nm(n, 0)]
        apex_mm, ring_mm = zernike_values(ring, np.zeros(2)) @ mean_mm
        sag_mm = float(ring_mm - apex_mm)
        radius_mm = (KERATOMETER_RADIUS_MM**2 + sag_mm**2) / (2.0 * sag_mm)
        return MM_PER_M * (KERATOMETER_INDEX - 1.0) / radius_mm


def mean_biometry() -> Biometry:
    """Return the biometry at the mean of all parameters."""
    model = _model()
    mean = model.weights @ model.mean
    return biometry_of(mean, _semi_axes_mm(float(mean[_LENGTH]), np.zeros(3)))


def drawn_biometry(sample: int) -> Biometry:
    """Return the biometry of a person.

    Parameters
    ----------
    sample : int
        Seed from 0 to 999,999; each is a person.

    Notes
    -----
    No draw is rejected: of two million, the thinnest cornea has 0.38 mm, the shallowest
    aqueous 0.8 mm, and all lens indices lie between 1.38 and 1.49.
    """
    # The stream of `RandomState` is the same in all versions of NumPy.
    random = np.random.RandomState([sample, BIOMETRY_STREAM])
    model = _model()
    which = int(random.random_sample() >= model.weights[0])
    normal = random.standard_normal(len(model.mean[which]))
    parameters = model.mean[which] + model.roots[which] @ normal
    length_mm = float(parameters[_LENGTH])
    return biometry_of(
        parameters, _semi_axes_mm(length_mm, random.standard_normal(len(_RETINA)))
    )


def biometry_of(
    parameters: NDArray[np.float64], retina_semi_axes_mm: tuple[float, float, float]
) -> Biometry:
    """Return the biometry that 18 parameters of the model stand for.

    Parameters
    ----------
    parameters : (18,)
        Depth of the aqueous, thickness of the lens, axial length, anterior and
        posterior radius of the lens, mm; power of the lens, dpt; coefficients of the
        principal components of the cornea, um.
    retina_semi_axes_mm : (x, y, z)
    """
    model = _model()
    cornea_mm = model.cornea_mean_mm + model.cornea_vectors @ parameters[6:] / UM_PER_MM
    aqueous, lens, length, anterior, posterior, power = parameters[:6].tolist()
    return Biometry(
        cornea_thickness_mm=float(cornea_mm[-1]),
        aqueous_depth_mm=aqueous,
        lens_thickness_mm=lens,
        axial_length_mm=length,
        lens_anterior_radius_mm=anterior,
        lens_posterior_radius_mm=posterior,
        lens_power_dpt=power,
        cornea_anterior_mm=cornea_mm[:N_TERMS],
        cornea_posterior_mm=cornea_mm[N_TERMS : 2 * N_TERMS],
        retina_semi_axes_mm=retina_semi_axes_mm,
    )


def eye_of_biometry(biometry: Biometry, *, eye_side: str) -> EyeSurfaces:
    """Return the surfaces of an eye.

    Parameters
    ----------
    biometry : Biometry
    eye_side : {"OD", "OS"}
        A left eye is the mirror image of a right one.

    Notes
    -----
    Indices at 555 nm are those of the model; media disperse light as those of
    `optics.media`.
    """
    lens_z_mm = biometry.cornea_thickness_mm + biometry.aqueous_depth_mm
    anterior_mm, posterior_mm = (
        biometry.lens_anterior_radius_mm,
        biometry.lens_posterior_radius_mm,
    )
    surfaces = (
        _cornea(biometry.cornea_anterior_mm, 0.0, "cornea", eye_side),
        _cornea(
            biometry.cornea_posterior_mm,
            biometry.cornea_thickness_mm,
            "aqueous",
            eye_side,
        ),
        Surface(
            radius_mm=(anterior_mm, anterior_mm),
            conic_constant=LENS_CONICS[0],
            z_mm=lens_z_mm,
            medium_after="lens",
            offset_mm=_seen_by_eye(_model().lens_mm, eye_side) * norms(),
            offset_radius_mm=LENS_RADIUS_MM,
        ),
        Surface(
            radius_mm=(posterior_mm, posterior_mm),
            conic_constant=LENS_CONICS[1],
            z_mm=lens_z_mm + biometry.lens_thickness_mm,
            medium_after="vitreous",
        ),
    )
    return EyeSurfaces(
        surfaces=surfaces,
        stop_z_mm=lens_z_mm,
        retina=_retina(biometry),
        media={
            "cornea": _medium("cornea", CORNEA_INDEX),
            "aqueous": _medium("aqueous", HUMOR_INDEX),
            "lens": _medium("lens", biometry.lens_index),
            "vitreous": _medium("vitreous", HUMOR_INDEX),
        },
    )


def with_drawn_eye(profile: EyeProfile, sample: int | None) -> EyeProfile:
    """Return a profile with the eye of a sample, of its side; None is the mean eye."""
    found = mean_biometry() if sample is None else drawn_biometry(sample)
    whose = "the mean of SyntEyes"
    if sample is not None:
        whose = f"drawn from SyntEyes with sample {sample}"
    note = Note(
        "drawn_eye",
        f"the eye is {whose}: axial length {found.axial_length_mm:.2f} mm, K "
        f"{found.keratometry_dpt:.2f} dpt, aqueous depth {found.aqueous_depth_mm:.2f} "
        f"mm, lens {found.lens_thickness_mm:.2f} mm and {found.lens_power_dpt:.2f} dpt",
        axial_length_mm=found.axial_length_mm,
        keratometry_dpt=found.keratometry_dpt,
        aqueous_depth_mm=found.aqueous_depth_mm,
        lens_thickness_mm=found.lens_thickness_mm,
        lens_power_dpt=found.lens_power_dpt,
    )
    others = [n for n in profile.notes if getattr(n, "code", "") != note.code]
    surfaces = SurfaceModel(eye_of_biometry(found, eye_side=profile.eye_side))
    return replace(profile, sample=sample, surfaces=surfaces, notes=(note, *others))


def _cornea(
    terms_mm: NDArray[np.float64], z_mm: float, medium_after: str, eye_side: str
) -> Surface:
    """Return a surface of the cornea: a paraboloid that has its defocus, and offsets.

    The sum of the two is the polynomial of the terms, without approximation.
    """
    offset_mm = _seen_by_eye(terms_mm, eye_side) * norms()
    c20 = index_from_nm(2, 0)
    defocus_mm = float(offset_mm[c20])
    radius_mm = CORNEA_RADIUS_MM**2 / (4.0 * defocus_mm)
    # defocus (2 r² - 1) is the paraboloid, whose sag is 0 at its apex, and a piston
    offset_mm[0] -= defocus_mm
    offset_mm[c20] = 0.0
    return Surface(
        radius_mm=(radius_mm, radius_mm),
        conic_constant=-1.0,
        z_mm=z_mm,
        medium_after=medium_after,
        offset_mm=offset_mm,
        offset_radius_mm=CORNEA_RADIUS_MM,
    )


def _seen_by_eye(terms_mm: NDArray[np.float64], eye_side: str) -> NDArray[np.float64]:
    """Return terms of a right eye, as an examiner sees it, in the frame of an eye."""
    return flip_horizontal(terms_mm) if eye_side == "OD" else terms_mm.copy()


def _retina(biometry: Biometry) -> Retina:
    x_mm, y_mm, z_mm = biometry.retina_semi_axes_mm
    return Retina(
        radius_mm=(x_mm**2 / z_mm, y_mm**2 / z_mm),
        conic_constant=0.0,
        z_mm=biometry.axial_length_mm,
        form=TwoConics((x_mm**2 / z_mm**2 - 1.0, y_mm**2 / z_mm**2 - 1.0)),
    )


def _medium(name: str, index: float) -> OcularHerzberger:
    """Return the medium of an index at 555 nm with the dispersion of an ocular one.

    The formula is a weighted mean of its four indices, so that all change by as much.
    """
    ocular = OCULAR_MEDIA[name]
    change = index - float(ocular.refractive_index(REFERENCE_WAVELENGTH_NM))
    n1, n2, n3, n4 = (known + change for known in ocular.indices)
    return OcularHerzberger((n1, n2, n3, n4))


_LENGTH = 2
_RETINA = (1, 2, 3)


@dataclass(frozen=True)
class _Model:
    """Coefficients of ``synteyes.json``, with roots of the covariances."""

    weights: NDArray[np.float64]
    mean: NDArray[np.float64]
    roots: NDArray[np.float64]
    cornea_mean_mm: NDArray[np.float64]
    cornea_vectors: NDArray[np.float64]
    lens_mm: NDArray[np.float64]
    retina_mean_mm: NDArray[np.float64]
    retina_slopes: NDArray[np.float64]
    retina_root_mm: NDArray[np.float64]


@cache
def _model() -> _Model:
    data: dict[str, Any] = json.loads(SYNTEYES_FILE.read_text(encoding="utf-8"))
    retina_mm2 = _symmetric(data["retina_covariance_mm2"])
    slopes = retina_mm2[0, _RETINA] / retina_mm2[0, 0]
    rest_mm2 = retina_mm2[np.ix_(_RETINA, _RETINA)] - np.outer(
        slopes, retina_mm2[0, _RETINA]
    )
    return _Model(
        weights=np.array(data["weights"]),
        mean=np.array(data["mean"]),
        roots=np.stack([_root(_symmetric(rows)) for rows in data["covariance"]]),
        cornea_mean_mm=np.array(data["cornea_mean_mm"]),
        cornea_vectors=np.array(data["cornea_vectors"]),
        lens_mm=padded_terms(data["lens_mm"], N_TERMS),
        retina_mean_mm=np.array(data["retina_mean_mm"]),
        retina_slopes=slopes,
        retina_root_mm=_root(rest_mm2),
    )


def _symmetric(rows: list[list[float]]) -> NDArray[np.float64]:
    """Return a symmetric matrix (n, n) from the rows of its lower triangle."""
    matrix = np.zeros((len(rows), len(rows)))
    for k, row in enumerate(rows):
        matrix[k, : k + 1] = matrix[: k + 1, k] = row
    return matrix


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a root (n, n) of a covariance that may be singular.

    The radii of the lens are functions of other parameters, so that the covariance has
    no Cholesky decomposition.  The symmetric root of the correlations is unique.
    """
    deviation = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(deviation[:, None] * root)


def _semi_axes_mm(
    length_mm: float, normal: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Return semi-axes of the retina, given the axial length and normal deviates."""
    model = _model()
    away_mm = length_mm - RETINA_THICKNESS_MM - model.retina_mean_mm[0]
    x_mm, y_mm, z_mm = (
        model.retina_mean_mm[list(_RETINA)]
        + model.retina_slopes * away_mm
        + model.retina_root_mm @ normal
    ).tolist()
    return x_mm, y_mm, z_mm
