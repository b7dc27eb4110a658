"""`best_lens`: the spectacles or contact lens that make scenes best for an eye.

The eye is built with each lens that the search tries, and the scenes are filtered
through it.  The search minimizes the difference from the target over the power vector
of the lens in the plane of the entrance pupil, and over the addition of a progressive
lens.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.acuity.best_correction import SECOND_ORDER, best_correction_um
from estimator.corrections.worn_lens import replaces_lens
from estimator.note import Note
from estimator.optics.prescription import (
    Prescription,
    power_at_cornea_dpt,
    power_vector_from_zernike,
    prescription_from_power_vector,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM
from estimator.profiles.measured_wavefront import profile_amplitude_dpt
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.correcting.correction import Report, check_choice, linear_light
from filter_service.correcting.lens_scene import (
    LENS_MEASURES,
    LensMeasure,
    LensScene,
    Sight,
    checked_scenes,
    focus_range_dpt,
)
from filter_service.correcting.solver import check_number
from filter_service.errors import BadMessage
from filter_service.filtering.builder import Builder
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.given_profile import Profile, as_profile
from filter_service.settings import DEFAULTS, FilterSettings, as_settings
from filter_service.waiting import Wait

LENS_KINDS = "spectacles", "contact_lens", "progressive"

VERTEX_MM = 12.0
POWER_STEP_DPT, AXIS_STEP_DEG = 0.25, 1.0
"""Steps in which lenses are made."""

RELAXING_ADD_DPT = 2.5
"""Near addition of a profile whose eye does not accommodate."""

SCAN_DPT, SCAN_STEP_DPT = 1.0, 0.5
"""Spheres added to the start: the measure may have several peaks."""

FIRST_RADIUS_DPT, LAST_RADIUS_DPT = 0.5, 0.01
"""Radii of the trust region, of the first and of the last steps."""

LEAST_ERROR = 1e-30
BOUND_DPT = 20.0
ADD_LIMITS_DPT = 0.25, 4.0
FIRST_ADD_DPT = 2.0
EVALUATION_LIMITS = 30, 1000


@dataclass(frozen=True)
class LensTrial:
    """A lens that the search tried.

    Attributes
    ----------
    prescription : Prescription
        Power of the lens in its own plane, with minus cylinder.
    add_dpt : float
        Addition of a progressive lens; 0 otherwise.
    error_db : float
        Weighted mean of the scenes' mean square differences by the measure; 0 dB is the
        square of white.
    """

    prescription: Prescription
    add_dpt: float
    error_db: float


@dataclass(frozen=True)
class BestLens:
    """The lens with which scenes are nearest to their targets, and the search for it.

    Images are float32, linear light, (height, width, 3), of the first scene.

    Attributes
    ----------
    best : LensTrial
        The lens with the smallest error.
    rounded : LensTrial
        That lens in steps of 0.25 dpt and 1°.
    start : LensTrial
        The lens with the highest visual Strehl ratio, which does not depend on the
        scene, for the farthest focus.
    error_before_db : float
        Error through the profile as it is given.
    trials : tuple of LensTrial
        All lenses in the order of the search.
    correction, rounded_correction : dict
        The ``correction`` of a profile with the lens, and with the rounded one.
    before, after, target : array
        The first scene through the profile as given, through the lens, and as meant.
    has_converged : bool
        Whether the search reached its smallest step within the evaluations.
    search_s : float
    notes : tuple of str
    """

    best: LensTrial
    rounded: LensTrial
    start: LensTrial
    error_before_db: float
    trials: tuple[LensTrial, ...]
    correction: dict[str, Any]
    rounded_correction: dict[str, Any]
    before: NDArray[np.float32]
    after: NDArray[np.float32]
    target: NDArray[np.float32]
    has_converged: bool
    search_s: float
    notes: tuple[str, ...]

    @property
    def gain_db(self) -> float:
        """Return the reduction of the error by the lens, dB."""
        return self.error_before_db - self.best.error_db

    @property
    def gain_over_start_db(self) -> float:
        """Return the reduction of the error relative to that of the start, dB."""
        return self.start.error_db - self.best.error_db

    @property
    def rounding_loss_db(self) -> float:
        """Return the increase of the error by rounding the lens, dB."""
        return self.rounded.error_db - self.best.error_db


def best_lens(
    profile: Profile,
    scenes: LensScene | Sequence[LensScene],
    *,
    lens: Mapping[str, Any] | None = None,
    target_eye: Profile | None = None,
    measure: LensMeasure = "luminance",
    has_cylinder: bool = True,
    max_evaluations: int = 120,
    settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
    builder: Builder | None = None,
    on_progress: Report | None = None,
) -> BestLens:
    """Find the lens with which an eye sees scenes as they are, or as another eye does.

    The eye is relaxed at the farthest focus of all scenes, as in a refraction: a lens
    that is too negative is an error, and accommodation does not compensate it.  At
    nearer foci, it accommodates as far as it can.

    Parameters
    ----------
    profile : profile
        The eye.  Spectacles or a contact lens of its own are replaced.
    scenes : LensScene or sequence of LensScene
    lens : mapping, optional
        The ``correction`` of a profile without its powers, of the kind "spectacles",
        "contact_lens" or "progressive"; by default spectacles 12 mm in front of the
        cornea.  The addition of a progressive lens is found as well.
    target_eye : profile, optional
        Eye through which the scenes should be seen; by default the targets are the
        scenes themselves.
    measure : "luminance", "retina" or "sensitivity"
        Mean square difference on the retina, in linear light: of the luminance,
        weighted by neural contrast sensitivity; of red, green and blue, which count
        alike; or of these, weighted by neural contrast sensitivity.
    has_cylinder : bool
        Whether the lens may have a cylinder.
    max_evaluations : int, 30 to 1000
        Most lenses to try.
    settings : FilterSettings or mapping, optional
        Its ranges of pupil, focus and distance are replaced by those of the scenes.
    builder : Builder, optional
        As for `EyeFilter`; by default one for this search, in the calling thread.
    on_progress : callable, optional
        Called with the completed fraction, 0 to 1, and the stage; otherwise, a bar on
        stderr shows the progress, as for `EyeFilter`.

    Returns
    -------
    BestLens

    Raises
    ------
    BadMessage
        If an argument is out of range (a ValueError, too).
    ValueError
        If a profile is invalid.
    SessionError
        If an eye could not be built.

    Notes
    -----
    The start is the correction with the highest visual Strehl ratio for the first
    scene with the farthest focus.  Its sphere is scanned in steps of 0.5 dpt, and
    COBYQA, a derivative-free trust-region method, continues from the best (Ragonneau
    and Zhang, 2023, as implemented in SciPy).  PSFs are exact for scenes at one
    distance.  Magnification by spectacles, displacement of the whole image, and
    yellowing are not errors.
    """
    body = {"kind": "spectacles", "vertex_mm": VERTEX_MM} | dict(lens or {})
    check_choice("lens.kind", body["kind"], LENS_KINDS)
    check_choice("measure", measure, LENS_MEASURES)
    check_number("max_evaluations", max_evaluations, EVALUATION_LIMITS)
    eye = _seen_plain(as_profile(profile))
    if replaces_lens(eye.correction):
        raise BadMessage(
            "it is an intraocular lens",
            field="profile.correction",
            allowed="spectacles, a contact lens or none",
        )
    targets_eye = None if target_eye is None else _seen_plain(as_profile(target_eye))
    begin_s = time.perf_counter()
    with (
        ExitStack() as closing,
        Wait("Searching the lens", is_shown=on_progress is None) as waiting,
    ):
        search = _Search(
            eye=eye,
            scenes=checked_scenes(scenes),
            body=body,
            target_eye=targets_eye,
            measure=measure,
            has_cylinder=has_cylinder,
            settings=as_settings(settings),
            # The default builder works in this thread: a worker process would have
            # to start again for each lens.
            builder=open_inline_builder(closing) if builder is None else builder,
        )

        def report(stage: str) -> None:
            fraction = min(len(search.trials) / max_evaluations, 1.0)
            waiting.update(len(search.trials), fraction, stage)
            if on_progress is not None:
                on_progress(fraction, stage)

        found = search.run(max_evaluations, report, begin_s)
    if on_progress is not None:
        on_progress(1.0, "lenses")
    return found


class _Search:
    """The scenes with their targets, and the lenses that were tried."""

    def __init__(
        self,
        *,
        eye: EyeProfile,
        scenes: Sequence[LensScene],
        body: Mapping[str, Any],
        target_eye: EyeProfile | None,
        measure: LensMeasure,
        has_cylinder: bool,
        settings: FilterSettings,
        builder: Builder,
    ) -> None:
        self.trials: list[LensTrial] = []
        self._eye, self._body, self._has_cylinder = eye, body, has_cylinder
        self._settings, self._builder = settings, builder
        self._is_progressive = body["kind"] == "progressive"
        self._farthest_dpt = min(focus_range_dpt(scene)[0] for scene in scenes)
        self._sights = [Sight(scene, measure) for scene in scenes]
        self._target_eye = target_eye
        self._vertex_mm = _lens_of(
            self._body_of(Prescription(0.0), FIRST_ADD_DPT)
        ).vertex_mm

    def run(
        self, max_evaluations: int, report: Callable[[str], None], begin_s: float
    ) -> BestLens:
        """Return the best lens."""
        report("targets")
        for sight in self._sights:
            target = linear_light(sight.scene.view)
            if self._target_eye is not None:
                target = self._image(self._target_eye, sight, is_refraction=False)[0]
            sight.target = target
        images, notes = self._images(self._eye)
        error_before_db, before = self._error_db(images), images[0]
        notes = [*dict.fromkeys(note for note in notes if not _is_of_focus(note))]
        report("start")
        has_converged = self._minimize(max_evaluations, report)
        best = min(self.trials, key=lambda trial: trial.error_db)
        rounded = rounded_prescription(best.prescription)
        add_dpt = best.add_dpt and _in_steps(best.add_dpt, POWER_STEP_DPT)
        rounded_body = self._body_of(rounded, add_dpt)
        body = self._body_of(best.prescription, best.add_dpt)
        search_s = time.perf_counter() - begin_s
        after = self._images(self._eye_with(body))[0]
        rounded_images = self._images(self._eye_with(rounded_body))[0]
        report("lenses")
        return BestLens(
            best=best,
            rounded=LensTrial(rounded, add_dpt, self._error_db(rounded_images)),
            start=self.trials[0],
            error_before_db=error_before_db,
            trials=tuple(self.trials),
            correction=body,
            rounded_correction=rounded_body,
            before=before,
            after=after[0],
            target=self._sights[0].target,
            has_converged=has_converged,
            search_s=search_s,
            notes=tuple(notes),
        )

    def _minimize(self, max_evaluations: int, report: Callable[[str], None]) -> bool:
        """Try lenses, the start first; return whether the search converged."""
        from scipy.optimize import Bounds, minimize  # loads slowly

        def error_db(x: NDArray[np.float64]) -> float:
            trial = self._try(x)
            report("lenses")
            return trial.error_db

        x0 = np.array(self._start()[: 3 if self._has_cylinder else 1])
        lows, highs = np.full(x0.size, -BOUND_DPT), np.full(x0.size, BOUND_DPT)
        if self._is_progressive:
            x0 = np.append(x0, self._first_add_dpt())
            lows, highs = (
                np.append(bounds, add_dpt)
                for bounds, add_dpt in zip((lows, highs), ADD_LIMITS_DPT, strict=True)
            )
        scanned = []
        for sphere_dpt in sorted(self._scan_dpt(), key=abs):
            x = x0.copy()
            x[0] += sphere_dpt
            scanned.append((error_db(x), x))
        _, x1 = min(scanned, key=lambda each: each[0])
        found = minimize(
            error_db,
            x1,
            method="COBYQA",
            bounds=Bounds(lows, highs),
            options={
                "initial_tr_radius": FIRST_RADIUS_DPT,
                "final_tr_radius": LAST_RADIUS_DPT,
                "maxfev": max_evaluations - len(self.trials),
            },
        )
        return bool(found.success)

    def _start(self) -> tuple[float, float, float]:
        """Return the power vector, at the pupil, with the highest visual Strehl."""
        from estimator.field.prepare import prepare_eye  # compiled: loads slowly

        sight = next(s for s in self._sights if s.range_dpt[0] == self._farthest_dpt)
        optics, _ = prepare_eye(
            replace(self._eye, correction=None, add_dpt=RELAXING_ADD_DPT),
            pupil_diameters_mm=(sight.scene.pupil_diameter_mm,),
            focus_range_dpt=(self._farthest_dpt, self._farthest_dpt),
            wavelengths_nm=(REFERENCE_WAVELENGTH_NM,),
            eye_model=self._settings.eye_model,
        )
        pupil_mm = optics.usable_pupil_mm(sight.scene.pupil_diameter_mm)
        state = {
            "pupil_diameter_mm": pupil_mm,
            "accommodation_dpt": 0.0,
            "wavelength_nm": REFERENCE_WAVELENGTH_NM,
        }
        total_dpt = optics.total_defocus_dpt(**state) + self._farthest_dpt
        seen = optics.wavefronts(
            h_deg=0.0, v_deg=0.0, **state, total_defocus_dpt=total_dpt
        )
        radius_mm = float(seen.circle_diameter_mm[0]) / 2.0
        best_um = best_correction_um(
            seen.zernike_um[0],
            zernike_radius_mm=radius_mm,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
            pupil_ellipse=seen.pupil_ellipse[0],
        )
        removed_um = np.zeros_like(best_um)
        removed_um[SECOND_ORDER] = (seen.zernike_um[0] - best_um)[SECOND_ORDER]
        return power_vector_from_zernike(removed_um, zernike_radius_mm=radius_mm)

    @property
    def _span_dpt(self) -> float:
        """Return the range of foci."""
        return max(s.range_dpt[1] for s in self._sights) - self._farthest_dpt

    def _scan_dpt(self) -> list[float]:
        """Return spheres to add to the start, up to those for the nearest focus."""
        last_dpt = SCAN_DPT
        if not self._is_progressive:
            last_dpt += min(self._span_dpt, ADD_LIMITS_DPT[1])
        n_steps = math.ceil((last_dpt + SCAN_DPT) / SCAN_STEP_DPT)
        return [k * SCAN_STEP_DPT - SCAN_DPT for k in range(n_steps + 1)]

    def _first_add_dpt(self) -> float:
        """Return the addition that the nearest focus requires without accommodation."""
        low_dpt, high_dpt = ADD_LIMITS_DPT
        return min(max(self._span_dpt, low_dpt), high_dpt)

    def _try(self, x: NDArray[np.float64]) -> LensTrial:
        """Return the error of a lens by its power vector at the pupil and addition."""
        m_dpt, j0_dpt, j45_dpt = x[:3] if self._has_cylinder else (x[0], 0.0, 0.0)
        add_dpt = float(x[-1]) if self._is_progressive else 0.0
        prescription = lens_from_power_vector(
            (float(m_dpt), float(j0_dpt), float(j45_dpt)), vertex_mm=self._vertex_mm
        )
        eye = self._eye_with(self._body_of(prescription, add_dpt))
        trial = LensTrial(prescription, add_dpt, self._error_db(self._images(eye)[0]))
        self.trials.append(trial)
        return trial

    def _body_of(self, prescription: Prescription, add_dpt: float) -> dict[str, Any]:
        """Return the ``correction`` of a profile with these powers."""
        powers: dict[str, Any] = {"sphere_dpt": prescription.sphere_dpt}
        if prescription.cylinder_dpt != 0.0:
            powers["cylinder_dpt"] = prescription.cylinder_dpt
            powers["axis_deg"] = prescription.axis_deg
        if self._is_progressive:
            powers["add_dpt"] = add_dpt
        body = {**self._body, **powers}
        if self._body["kind"] == "contact_lens":
            body.pop("vertex_mm", None)
        return body

    def _eye_with(self, body: Mapping[str, Any]) -> Callable[[Sight], EyeProfile]:
        """Return the eye with a lens, for the gaze of each scene."""

        def eye_for(sight: Sight) -> EyeProfile:
            own = dict(body)
            if self._is_progressive:
                own["gaze_deg"] = list(sight.scene.gaze_deg)
            return replace(self._eye, correction=_lens_of(own))

        return eye_for

    def _images(
        self, eye: EyeProfile | Callable[[Sight], EyeProfile]
    ) -> tuple[list[NDArray[np.float32]], list[str]]:
        """Return the images of all scenes, and notes."""
        found: list[NDArray[np.float32]] = []
        notes: list[str] = []
        for sight in self._sights:
            own = eye if isinstance(eye, EyeProfile) else eye(sight)
            image, own_notes = self._image(own, sight, is_refraction=True)
            found.append(image)
            notes += own_notes
        return found, notes

    def _error_db(self, images: Sequence[NDArray[np.float32]]) -> float:
        """Return the weighted mean of the errors of the scenes' images, dB."""
        errors = [s.error(image) for s, image in zip(self._sights, images, strict=True)]
        weights = [sight.scene.weight_ratio for sight in self._sights]
        mean = float(np.average(errors, weights=weights))
        return 10.0 * math.log10(max(mean, LEAST_ERROR))

    def _image(
        self, eye: EyeProfile, sight: Sight, *, is_refraction: bool
    ) -> tuple[NDArray[np.float32], tuple[str, ...]]:
        """Return the image of a scene; each pixel from the frame of its own focus."""
        can_focus = profile_amplitude_dpt(eye) > 0.0
        image: NDArray[np.float32] | None = None
        notes: tuple[str, ...] = ()
        for focus_dpt, pixels in sight.foci(can_focus=can_focus):
            is_farthest = image is None and sight.range_dpt[0] == self._farthest_dpt
            is_relaxed = is_refraction and is_farthest
            own = replace(eye, add_dpt=RELAXING_ADD_DPT) if is_relaxed else eye
            seen, notes = self._filtered(own, sight, focus_dpt)
            image = seen if image is None else np.where(pixels[..., None], seen, image)
        assert image is not None
        return image, notes

    def _filtered(
        self, eye: EyeProfile, sight: Sight, focus_dpt: float
    ) -> tuple[NDArray[np.float32], tuple[str, ...]]:
        scene = sight.scene
        pupil_mm = scene.pupil_diameter_mm
        settings = self._settings.changed(
            pupil_range_mm=(pupil_mm, pupil_mm),
            focus_range_dpt=(focus_dpt, focus_dpt),
            object_range_dpt=sight.objects_dpt,
        )
        with EyeFilter(
            eye,
            scene.view.camera,
            settings,
            on_event=lambda event: None,  # the search shows its own progress
            builder=self._builder,
        ) as eye_filter:
            found = eye_filter.filter(
                scene.view,
                pupil_diameter_mm=pupil_mm,
                focus_dpt=focus_dpt,
                output="linear",
                merge=False,  # merging depends on the image, in steps
                bright_pixels=False,
                render_tolerance=0.0 if sight.is_flat else 1.0,
                whole=True,
            )
        return np.asarray(found.color, np.float32), found.notes


def lens_from_power_vector(
    vector_dpt: tuple[float, float, float], *, vertex_mm: float
) -> Prescription:
    """Return the lens at a distance from the cornea for a power vector at the pupil."""
    at_pupil = prescription_from_power_vector(*vector_dpt)
    behind_mm = -(vertex_mm + TYPICAL_ENTRANCE_PUPIL_MM)
    sphere_dpt, other_dpt = (
        power_at_cornea_dpt(power_dpt, vertex_mm=behind_mm)
        for power_dpt in (
            at_pupil.sphere_dpt,
            at_pupil.sphere_dpt + at_pupil.cylinder_dpt,
        )
    )
    return Prescription(
        sphere_dpt, other_dpt - sphere_dpt, at_pupil.axis_deg, vertex_mm
    )


def rounded_prescription(lens: Prescription) -> Prescription:
    """Return a lens in steps of 0.25 dpt and 1°, with the nearest mean power."""
    cylinder_dpt = _in_steps(lens.cylinder_dpt, POWER_STEP_DPT)
    mean_dpt = lens.sphere_dpt + lens.cylinder_dpt / 2.0
    axis_deg = _in_steps(lens.axis_deg, AXIS_STEP_DEG) % 180.0 or 180.0
    return Prescription(
        _in_steps(mean_dpt - cylinder_dpt / 2.0, POWER_STEP_DPT),
        cylinder_dpt,
        axis_deg,
        lens.vertex_mm,
    )


def _in_steps(value: float, step: float) -> float:
    return round(value / step) * step


def _is_of_focus(note: str) -> bool:
    """Return whether a note is about accommodation, which the search excludes."""
    return isinstance(note, Note) and note.code.startswith("focus_")


def _seen_plain(profile: EyeProfile) -> EyeProfile:
    """Return a profile without effects that no lens changes."""
    return replace(profile, spectacle_magnification=False, yellowing=None)


def _lens_of(body: Mapping[str, Any]) -> Prescription:
    """Return the lens of a profile's ``correction``.

    Raises
    ------
    ProfileError
        If it is invalid; the message names the field.
    """
    plain = {"kind": "prescription", "sphere_dpt": 0.0, "correction": dict(body)}
    found = parse_profile(plain).correction
    assert found is not None
    return found
