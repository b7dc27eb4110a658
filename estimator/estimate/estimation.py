"""Estimation of an eye's 45 parameters from one or several measured wavefronts.

``refined``: bounded least squares on exactly ray-traced coefficients, with a weak prior
toward the mean eye of the measured refraction.  It starts from the nearest of a table
of eyes and the eye network's guess.  ``network``: that guess alone, checked by one
trace.  ``search``: the pattern search of the earlier work.

Notes name properties of an estimated eye that would be unusual in a person.  These
limits are soft: the prior draws an eye toward usual values, but a wavefront may require
others.  Lengths are three deviations about the means of 19,500 to 90,800 eyes of ten
countries (axial length 23.49 ± 1.35 mm, corneal radius 7.69 ± 0.28 mm, chamber depth
with the cornea 3.10 ± 0.47 mm: "Global metrics on ocular biometry", Eye 2022).  The
cornea's power follows from its radii; the lens has 22.6 ± 2.1 dpt (Rozema 2012).
"""

import json
import time
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.bounded_fit import BoundedFit
from estimator.estimate.measured_residual import MeasuredResidual
from estimator.estimate.problem import EstimationProblem, pattern_search
from estimator.eye.accommodation import AccommodatingEye, FocusedEye
from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import (
    PARAMETER_NAMES,
    EyeParameters,
    RetinaShape,
    allowed_ranges,
    mean_vector,
)
from estimator.networks.inference import (
    DamagedWeights,
    NetworkUnavailable,
    NetworkUnfit,
    WeightsMissing,
    network_eye,
)
from estimator.note import Note
from estimator.optics.paraxial import cardinal_points
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS, padded_terms, remove_central_tilt
from estimator.profiles.measured_wavefront import profile_amplitude_dpt
from estimator.profiles.parse import EyeProfile
from estimator.profiles.typical_aberrations import (
    typical_note,
    with_typical_aberrations,
)

if TYPE_CHECKING:
    from estimator.optics.surfaces import EyeSurfaces

TABLE_FILE = Path(__file__).parent / "eye_table.json"


@cache
def table_vectors() -> NDArray[np.float64]:
    """Return the vectors (P, 45) of the table; the first is the mean eye."""
    rows = json.loads(TABLE_FILE.read_text(encoding="utf-8"))["eyes"]
    vectors: list[list[float]] | NDArray[np.float64]
    vectors = [[row[name] for name in PARAMETER_NAMES] for row in rows]
    vectors = np.array([mean_vector().tolist(), *vectors])
    vectors.setflags(write=False)
    return vectors


USUAL = {
    "corneal power": ((38.5, 48.5), "dpt"),
    "lens power": ((16.3, 28.9), "dpt"),
    "chamber depth": ((1.7, 4.5), "mm"),
    "eye length": ((19.4, 27.6), "mm"),
}


def unusual(
    parameters: EyeParameters, *, retina: RetinaShape | None = None
) -> tuple[str, ...]:
    """Return the properties outside their usual ranges, with value and range."""
    points = cardinal_points(
        eye_surfaces(parameters, retina=retina), wavelength_nm=REFERENCE_WAVELENGTH_NM
    )
    depth_mm = parameters.cornea_thickness_mm + parameters.aqueous_thickness_mm
    values = {
        "corneal power": points.cornea_power_dpt,
        "lens power": points.lens_power_dpt,
        "chamber depth": depth_mm,
        "eye length": parameters.eye_length_mm,
    }
    return tuple(
        f"{name} {value:.1f} {USUAL[name][1]} (usual {low:g} to {high:g})"
        for name, value in values.items()
        for low, high in [USUAL[name][0]]
        if not low <= value <= high
    )


def network_guess(profile: EyeProfile) -> NDArray[np.float64]:
    """Return parameters (45,) within their allowed ranges.

    Only the profile's leading measurement is used, which is on the axis.

    Raises
    ------
    NetworkUnavailable
        No weights, or a wavefront outside the training ranges.
    """
    vector = network_eye(
        profile.zernike_um[:N_TERMS],
        pupil_diameter_mm=profile.pupil_diameter_mm,
        wavelength_nm=profile.wavelength_nm,
    )
    return np.clip(vector, *allowed_ranges().T)


METHODS = ("network", "refined", "search")
STARTS = ("table", "network")
"""Start eyes of ``refined``: the built-in table or the network's guess.

The default is the table, also where a process has loaded the network.  From the
network's guess keratoconus is found in 23 instead of 35 ms, but as an eye with other
wavefronts off the axis (0.36 um RMS at 20 deg, 5 mm; post-LASIK 0.10 um), and an image
must not depend on what a process has loaded.
"""

GOOD_FIT_UM = 5e-4
"""Mean error above which a fit is repeated from the other kind of start: from the
network's eye, keratoconus ends at 7e-3 um, from the table's at 3e-5."""

POOR_FIT_UM = 0.01
"""Mean error above which a note says that the model does not match the data."""

SEARCH_TIME_S = 60.0
"""Time limit of the pattern search; the published runs took one to three hours."""


@dataclass(frozen=True)
class EstimatedEye:
    """An eye that reproduces a measurement, with the quality of the fit.

    Attributes
    ----------
    name : str
        Name of the profile.
    parameters : EyeParameters
        Parameters of the relaxed eye.
    profile : EyeProfile
        Profile that was fitted, typical aberrations included.
    zernike_um, residual_um : (n_terms,), um
        Coefficients of the eye, and of the eye minus the measurement, on the measured
        circle (``zernike_radius_mm``) at ``wavelength_nm``; for several measurements,
        of the first.  The residual's tilt is relative to the measurement shifted to
        zero central slope.
    mean_abs_error_um : float
        Mean absolute error over the 25 terms without piston and tilt, and over all
        measurements.
    method : str
        Method that was finally used: ``network`` falls back to ``refined``.
    start : str
        Start of ``refined``, one of `STARTS` or ``given``; empty for other methods.
    network_reason : str
        Reason for a fallback from the network; empty without one.
    time_ms, n_iterations, n_evaluations : float, int, int
        Cost of the estimation; an evaluation traces one eye.
    on_bound : tuple of str
        Parameters on a bound of their allowed range.
    notes : tuple of str
        Notes for the user, in sentences.
    """

    name: str
    method: str
    parameters: EyeParameters
    profile: EyeProfile
    zernike_um: NDArray[np.float64]
    residual_um: NDArray[np.float64]
    zernike_radius_mm: float
    wavelength_nm: float
    mean_abs_error_um: float
    time_ms: float
    n_iterations: int
    n_evaluations: int
    on_bound: tuple[str, ...]
    notes: tuple[str, ...]
    start: str = ""
    network_reason: str = ""

    @property
    def retina(self) -> RetinaShape | None:
        """Return the retina of the profile, None for a sphere."""
        return self.profile.retina

    @cached_property
    def determined_ratio(self) -> dict[str, float]:
        """Return how well each parameter is determined; costs one Jacobian.

        This is the fraction of the prior variance that a measurement with 0.01 um noise
        per coefficient removes: 0 is the prior alone, 1 is known.
        """
        if self.profile.is_given:
            return dict.fromkeys(PARAMETER_NAMES, 1.0)
        problem = EstimationProblem(self.profile)
        return problem.determined_ratio(self.parameters.to_vector())

    def rest(
        self, wavelengths_nm: ArrayLike, *, n_traced_terms: int = N_TERMS
    ) -> MeasuredResidual:
        """Return the residual of the measurement and this eye, at wavelengths.

        It is added to traced wavefronts of ``n_traced_terms``.
        """
        return MeasuredResidual.of(
            self.parameters,
            self.profile,
            wavelengths_nm=wavelengths_nm,
            n_traced_terms=n_traced_terms,
        )

    @property
    def relaxed(self) -> "EyeSurfaces":
        """Return the surfaces of the relaxed eye."""
        return eye_surfaces(self.parameters, retina=self.retina)

    @property
    def eye_length_mm(self) -> float:
        """Return the length of the eye."""
        return self.parameters.eye_length_mm

    @cached_property
    def accommodating(self) -> AccommodatingEye:
        """Return the eye as one that can focus, with its correction."""
        return AccommodatingEye(
            self.parameters,
            retina=self.retina,
            pupil_diameter_mm=self.profile.pupil_diameter_mm,
            amplitude_dpt=profile_amplitude_dpt(self.profile),
            correction=self.profile.correction,
            rest=self.rest(REFERENCE_WAVELENGTH_NM),
        )

    @property
    def refraction_dpt(self) -> float:
        """Return M at 555 nm and the measured pupil, through the correction."""
        return self.accommodating.refraction_dpt

    @property
    def amplitude_dpt(self) -> float:
        """Return the largest accommodation, by age, addition and lens."""
        return self.accommodating.amplitude_dpt

    def focused(
        self, focus_dpt: float = 0.0, *, pupil_diameter_mm: float | None = None
    ) -> FocusedEye:
        """Return the eye focused as near to ``focus_dpt`` as possible.

        Parameters
        ----------
        pupil_diameter_mm : float, optional
            Pupil through which that distance is sharpest; the measured pupil by
            default.
        """
        return self.accommodating.focused(
            focus_dpt, pupil_diameter_mm=pupil_diameter_mm
        )

    def surfaces(
        self, focus_dpt: float = 0.0, *, pupil_diameter_mm: float | None = None
    ) -> "EyeSurfaces":
        """Return the surfaces of `focused`."""
        return self.focused(focus_dpt, pupil_diameter_mm=pupil_diameter_mm).surfaces


def estimate_eye(
    profile: EyeProfile,
    *,
    method: str = "refined",
    max_time_s: float = SEARCH_TIME_S,
    starts: tuple[str, ...] = ("table",),
    start_vectors: NDArray[np.float64] | None = None,
) -> EstimatedEye:
    """Estimate the eye behind a profile.

    Parameters
    ----------
    profile : EyeProfile
        Profile.  An eye is returned as given, with method ``given``.  A prescription
        gets typical higher-order aberrations first, with a note, unless its
        ``higher_order`` is ``none``.  With surgery, this is the eye before it.
    method : {"network", "refined", "search"}
        Method.  If the wavefront is outside the network's training ranges, or light
        does not pass its eye, ``network`` falls back to ``refined`` from the table,
        with a note.
    max_time_s : float
        Time limit of ``search``.
    starts : of {"table", "network"}
        Candidate eyes; ``refined`` starts at the one whose traced wavefront is nearest.
        An unavailable network is skipped.  If a fit ends above `GOOD_FIT_UM`, the other
        kind is tried as well.
    start_vectors : (P, 45), optional
        Candidate eyes that replace those.

    Raises
    ------
    ValueError
        The method or a start is unknown, or the profile defines the eye by its
        surfaces.
    WeightsMissing, DamagedWeights
        The weights of ``network`` are missing or damaged.
    """
    if method not in METHODS:
        raise ValueError(f"method '{method}': allowed are {', '.join(METHODS)}")
    if not starts or not set(starts) <= set(STARTS):
        raise ValueError(f"starts {starts}: allowed are {', '.join(STARTS)}")
    if profile.surfaces is not None:
        raise ValueError(
            f"profile kind '{profile.kind}' defines the eye by its surfaces, not by "
            "the parameters of the eye model: allowed are the other kinds"
        )
    if profile.surgery is not None:
        found = estimate_eye(
            profile.before_surgery,
            method=method,
            max_time_s=max_time_s,
            starts=starts,
            start_vectors=start_vectors,
        )
        note = Note("eye_before_surgery", "this is the eye before surgery")
        return replace(found, notes=(note, *found.notes))
    if profile.higher_order != "none":
        found = estimate_eye(
            with_typical_aberrations(profile),
            method=method,
            max_time_s=max_time_s,
            starts=starts,
            start_vectors=start_vectors,
        )
        return replace(found, notes=(typical_note(profile), *found.notes))
    start_s = time.perf_counter()
    if profile.eye is not None:
        return _given(profile, start_s)
    problem = EstimationProblem(profile)
    if method == "search":
        return _searched(problem, start_s, max_time_s)
    reason = ""
    if method == "network":
        try:
            return _guessed(problem, start_s)
        except (WeightsMissing, DamagedWeights):
            raise
        except NetworkUnavailable as error:
            starts, reason = ("table",), str(error)
    if start_vectors is None:
        start_vectors, labels, why = _start_vectors(profile, starts)
        reason = reason or why
    else:
        labels = ("given",) * len(start_vectors)
    found = _refined(problem, start_s, start_vectors, labels, reason)
    if method == "network":
        note = Note("not_by_network", f"not by network: {reason}")
        found = replace(found, notes=(note, *found.notes))
    return found


def _answer(
    problem: EstimationProblem,
    method: str,
    *,
    vector: NDArray[np.float64],
    values_um: NDArray[np.float64],
    start_s: float,
    counts: tuple[int, int],
    start: str = "",
    network_reason: str = "",
) -> EstimatedEye:
    error_um = float(np.mean(np.abs(values_um - problem.target_um)))
    on_bound = problem.on_bound(vector)
    vector = np.clip(vector, *allowed_ranges().T)  # rounding may exceed a bound
    zernike_um = problem.zernike_of(problem.measurements[0])(vector[None])[0]
    zernike_um[0] = 0.0
    measured_um = remove_central_tilt(problem.profile.zernike_um)
    zernike_um = padded_terms(zernike_um, measured_um.size)
    residual_um = zernike_um - measured_um
    parameters = EyeParameters.from_vector(vector)
    residual_um[0] = 0.0
    return EstimatedEye(
        name=problem.profile.name,
        method=method,
        parameters=parameters,
        profile=problem.profile,
        zernike_um=zernike_um,
        residual_um=residual_um,
        zernike_radius_mm=problem.profile.pupil_diameter_mm / 2.0,
        wavelength_nm=problem.profile.wavelength_nm,
        mean_abs_error_um=error_um,
        time_ms=1000.0 * (time.perf_counter() - start_s),
        n_iterations=counts[0],
        n_evaluations=counts[1],
        on_bound=on_bound,
        notes=(*_notes(error_um, method), *_unusual(parameters, problem.profile)),
        start=start,
        network_reason=network_reason,
    )


def _notes(error_um: float, method: str) -> tuple[str, ...]:
    if error_um <= POOR_FIT_UM:
        return ()
    which = "network's eye" if method == "network" else "eye model"
    note = Note(
        "poor_fit",
        f"the {which} reaches this wavefront only to {error_um:.2g} um on average: the "
        "rest is added to it near the axis",
        mean_error_um=error_um,
    )
    return (note,)


def _unusual(parameters: EyeParameters, profile: EyeProfile) -> tuple[str, ...]:
    named = unusual(parameters, retina=profile.retina)
    text = f"unusual for a person: {'; '.join(named)}"
    return (Note("unusual_eye", text),) if named else ()


def _start_vectors(
    profile: EyeProfile, starts: tuple[str, ...]
) -> tuple[NDArray[np.float64], tuple[str, ...], str]:
    """Return eyes (P, 45), their origins, and why the network has none."""
    labels: tuple[str, ...]
    vectors, labels, reason = np.empty((0, len(PARAMETER_NAMES))), (), ""
    if "network" in starts:
        try:
            vectors, labels = network_guess(profile)[None], ("network",)
        except NetworkUnavailable as error:
            reason = str(error)
    if "table" in starts or not labels:
        table = table_vectors()
        vectors = np.concatenate([vectors, table])
        labels += ("table",) * len(table)
    return vectors, labels, reason


def _refined(
    problem: EstimationProblem,
    start_s: float,
    start_vectors: NDArray[np.float64],
    labels: tuple[str, ...],
    reason: str,
) -> EstimatedEye:
    fit, label = _best_fit(problem, start_vectors, np.array(labels))
    return _answer(
        problem,
        "refined",
        vector=problem.prior.from_unit(fit.position_ratio),
        values_um=fit.values_um,
        start_s=start_s,
        counts=(fit.n_iterations, fit.n_evaluations),
        start=label,
        network_reason=reason,
    )


def _best_fit(
    problem: EstimationProblem, vectors: NDArray[np.float64], labels: NDArray[Any]
) -> tuple[BoundedFit, str]:
    """Fit from the nearest start, and from the other kind of start if that fits poorly.

    The counts are the sums over both.
    """
    best, used = None, ""
    while len(vectors):
        nearest = problem.nearest(vectors)
        fit, label = problem.refine(vectors[nearest]), str(labels[nearest])
        if best is not None:
            steps = best.n_iterations + fit.n_iterations
            traced = best.n_evaluations + fit.n_evaluations
            best, fit = (
                replace(f, n_iterations=steps, n_evaluations=traced)
                for f in (best, fit)
            )
        if best is None or problem.error_um(fit) < problem.error_um(best):
            best, used = fit, label
        if problem.error_um(best) <= GOOD_FIT_UM:
            break
        vectors, labels = vectors[labels != label], labels[labels != label]
    return cast(BoundedFit, best), used  # there is a start


def _guessed(problem: EstimationProblem, start_s: float) -> EstimatedEye:
    """Return the network's eye, with its traced error.

    Raises
    ------
    NetworkUnavailable
        The network is unavailable, or light does not pass its eye.
    """
    vector = network_guess(problem.profile)
    values_um = problem.compared_um(vector[None])[0]
    if not np.all(np.isfinite(values_um)):
        raise NetworkUnfit("light does not pass the network's eye")
    return _answer(
        problem,
        "network",
        vector=vector,
        values_um=values_um,
        start_s=start_s,
        counts=(0, 1),
    )


def _searched(
    problem: EstimationProblem, start_s: float, max_time_s: float
) -> EstimatedEye:
    first = problem.measurements[0]
    zernike_of = problem.zernike_of(first)
    found = pattern_search(
        zernike_of, target_um=first.zernike_um, max_time_s=max_time_s
    )
    vector = found.parameters.to_vector()
    return _answer(
        problem,
        "search",
        vector=vector,
        values_um=problem.compared_um(vector[None])[0],
        start_s=start_s,
        counts=(found.n_iterations, found.n_evaluations),
    )


def _given(profile: EyeProfile, start_s: float) -> EstimatedEye:
    assert profile.eye is not None
    return EstimatedEye(
        name=profile.name,
        method="given",
        parameters=profile.eye,
        profile=profile,
        zernike_um=profile.zernike_um,
        residual_um=np.zeros(N_TERMS),
        zernike_radius_mm=profile.pupil_diameter_mm / 2.0,
        wavelength_nm=profile.wavelength_nm,
        mean_abs_error_um=0.0,
        time_ms=1000.0 * (time.perf_counter() - start_s),
        n_iterations=0,
        n_evaluations=0,
        on_bound=(),
        notes=(),
    )
