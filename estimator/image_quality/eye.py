"""`Eye`: PSF, MTF, through-focus curves, refraction and acuity of a profile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.acuity.predict import retina_log_mar
from estimator.acuity.transfer import neural_sensitivity
from estimator.field.field_table import at_cornea_um
from estimator.image_quality.labeled_array import QUANTITY, LabeledArray
from estimator.image_quality.pupil_light import (
    ACUITY,
    MAX_PSF_RADIUS_PX,
    REFRACTION,
    PupilLight,
    acuity_of,
    finest_psfs,
    lens_of,
    mapped,
    psf_batches,
)
from estimator.image_quality.states import (
    MAX_FREQUENCY_CPD,
    StateGrid,
    States,
    check_choice,
    frequencies_cpd,
    listed,
    result_of,
    state_grid,
)
from estimator.image_quality.traced_states import StateTracer
from estimator.media import DEFAULT_AGE_YEARS, Straylight
from estimator.optics.units import MRAD_PER_RAD
from estimator.profiles.files import load_profile
from estimator.profiles.parse import EyeProfile
from estimator.psf.compute import disc_mask, plan_psfs
from estimator.psf.stiles_crawford import StilesCrawford

FREQUENCY_CPD = np.arange(61.0)
"""Frequencies of transfer functions by default: up to the Nyquist frequency of foveal
cones."""

RADIUS_ARCMIN = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
DEFOCUS_DPT = np.linspace(-2.0, 2.0, 17)
ISO_CPD = 15.0
"""Frequency of through-focus modulation: 50 cycles per mm in ISO 11979."""

THROUGH_FOCUS = (*ACUITY, "modulation_ratio")
REFRACTION_METHODS = ("least_squares", "visual_strehl")
PLANES = ("cornea", "pupil")

MAX_PSF_VALUES = 100_000_000
PIXEL_LIMITS_ARCMIN = (0.01, 60.0)
ARCMIN_PER_DEG = 60.0
MAX_RADIUS_ARCMIN = 600.0
MAX_DEFOCUS_DPT = 20.0


class Eye:
    """Optical quality of an eye in any states, as arrays with named axes.

    Results agree with the PSFs that the filter uses, on and off the axis, and with the
    commands of the same names.  A correction in the profile is worn.

    Each method accepts the arguments below, as a number or a list.  Each list becomes
    an axis of the result with the name of the argument, and lists of different
    arguments are combined with each other: two pupils and three distances are six
    states.  Name the axis to combine lists element by element, as in
    ``h_deg=("direction", [0, 20]), v_deg=("direction", [0, 5])``.  The axes of the
    states, in the order below, precede those of the method.

    - ``h_deg``, ``v_deg``: direction of the source, to the person's right and up; the
      axis by default.
    - ``pupil_diameter_mm``: entrance pupil at 555 nm, 0.5 to 12; 4 by default.
    - ``focus_dpt``: distance that the eye focuses, as well as it can.  By default, it
      is relaxed in `wavefront` and `refraction`, and focused at infinity in the other
      methods, as in the commands; an eye given by its surfaces is relaxed.
    - ``object_dpt``: distance of the source from the entrance pupil; infinity by
      default, negative for virtual objects.
    - ``wavelength_nm``: 380 to 780; 555 by default.

    A state takes about 20 ms to trace and is kept, so that other methods and object
    distances reuse it.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path
        A profile, its fields, the name of a preset or schematic eye, or a file.

    Raises
    ------
    ValueError
        The profile is invalid, an argument is out of range, or light does not pass the
        eye in a state.
    TypeError
        An argument is unknown.

    Examples
    --------
    >>> from ocufilter import Eye
    >>> eye = Eye("emmetropia")
    >>> modulation = eye.mtf(frequency_cpd=[10, 20, 30], pupil_diameter_mm=[3, 4, 5])
    >>> modulation.dims
    ('pupil_diameter_mm', 'frequency_cpd')
    """

    def __init__(self, profile: EyeProfile | Mapping[str, Any] | str | Path):
        if not isinstance(profile, EyeProfile):
            profile = load_profile(profile)
        self.profile = profile
        self._tracer = StateTracer(profile)

    @property
    def stiles_crawford(self) -> StilesCrawford:
        """Stiles-Crawford effect of this eye, by its side."""
        return StilesCrawford.of_eye(self.profile.eye_side)

    @property
    def straylight(self) -> Straylight:
        """Scatter of the profile; if it states none, of a healthy eye of its age."""
        if self.profile.straylight is not None:
            return self.profile.straylight
        return Straylight(age_years=self.profile.age_years or DEFAULT_AGE_YEARS)

    def wavefront(
        self, *, plane: str = "cornea", **states: Unpack[States]
    ) -> LabeledArray:
        """Return Zernike coefficients, OSA, um, with the axis ``term``.

        The coordinates ``zernike_radius_mm`` and ``pupil_...`` describe the circle
        about the chief ray and the ellipse of the pupil within it.

        Parameters
        ----------
        plane : {"cornea", "pupil"}
            Plane of the wavefront: cornea, as instruments and the commands `wavefront`
            and `field`, or entrance pupil, from which PSFs are computed.
        **states
            See `Eye`.
        """
        check_choice("plane", plane, PLANES)
        grid = state_grid(states)
        waves, notes = self._tracer.wavefronts(grid)
        zernike_um = waves.zernike_um
        if plane == "cornea":
            depth_mm = self._tracer.entrance_pupil_mm
            zernike_um = at_cornea_um(waves, entrance_pupil_mm=depth_mm)
        x, y, major, minor, angle = waves.pupil_ellipse.T
        circles = {
            "zernike_radius_mm": waves.circle_diameter_mm / 2.0,
            "pupil_x_mm": x,
            "pupil_y_mm": y,
            "pupil_semi_major_mm": major,
            "pupil_semi_minor_mm": minor,
            "pupil_major_axis_deg": np.degrees(angle),
        }
        return result_of(
            grid,
            zernike_um,
            {"term": np.arange(zernike_um.shape[-1])},
            "zernike_um",
            notes,
            coords={k: v.reshape(grid.shape) for k, v in circles.items()},
        )

    def psf(
        self,
        *,
        pixel_arcmin: float = 0.5,
        radius_arcmin: float | None = None,
        white_light: bool = False,
        stiles_crawford: bool = False,
        straylight: bool = False,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return point-spread functions integrated over pixels.

        The axes ``y_arcmin`` and ``x_arcmin`` follow those of the states, in image
        orientation: rows grow downward.  The chief ray is at 0, 0.  Values are shares
        of the light.

        Parameters
        ----------
        pixel_arcmin : float
            Side of a pixel.
        radius_arcmin : float, optional
            Radius of the disc of pixels.  By default, it is the largest one that a
            state requires for 99.9 % of its light, and the sum is 1.
        white_light : bool
            Whether the light is an equal-energy white, as the eye weights it: 457.1,
            534.0 and 609.5 nm with weights of 0.0384, 0.5760 and 0.3856.  All have
            the wavefront of ``wavelength_nm``, out of focus by the chromatic aberration
            between the two wavelengths, and the centered Stiles-Crawford effect.  The
            result has the coordinate ``light``.
        stiles_crawford : bool
            Whether to apply the Stiles-Crawford effect to light of one wavelength.
        straylight : bool
            Whether to add the light that the media scatter, of which the disc contains
            a part: the sum is below 1.
        **states
            See `Eye`.
        """
        listed("pixel_arcmin", float(pixel_arcmin), PIXEL_LIMITS_ARCMIN)
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        screen = self._tracer.rings and self._tracer.rings.seen_from(
            grid.flat["h_deg"], grid.flat["v_deg"]
        )
        apodization = self._apodization(stiles_crawford)
        batches = psf_batches(
            lights,
            white_light=white_light,
            pixel_pitch_mrad=MRAD_PER_RAD * np.radians(pixel_arcmin / ARCMIN_PER_DEG),
            stiles_crawford=apodization,
            pupil_screen=screen,
        )
        needed_px = max(int(plan_psfs(**batch).radius_px.max()) for _, batch in batches)
        radius_px = needed_px
        if radius_arcmin is not None:
            limits = 0.0, MAX_PSF_RADIUS_PX * pixel_arcmin
            listed("radius_arcmin", float(radius_arcmin), limits)
            radius_px = round(radius_arcmin / pixel_arcmin)
        # A kernel that is narrower than its light contains an image of the rest.
        computed_px = max(needed_px, radius_px)
        side = 2 * computed_px + 1
        if grid.count * side**2 > MAX_PSF_VALUES:
            raise ValueError(
                f"{grid.count} PSFs of {side} x {side} pixels: expected at most "
                f"{MAX_PSF_VALUES:.0e} values; use larger pixels or fewer states"
            )
        kernels = np.zeros((grid.count, side, side), np.float32)
        for weight, batch in batches:
            found = finest_psfs(**batch, radius_px=computed_px)
            kernels += np.float32(weight) * found.flat_kernels.reshape(kernels.shape)
        if radius_px < computed_px:
            kept = slice(computed_px - radius_px, computed_px + radius_px + 1)
            kernels = kernels[:, kept, kept] * disc_mask(radius_px)
        along = np.arange(-radius_px, radius_px + 1) * pixel_arcmin
        if straylight:
            scatter = self.straylight
            angle_deg = np.hypot(along[:, None], along) / ARCMIN_PER_DEG
            pixel_sr = np.radians(pixel_arcmin / ARCMIN_PER_DEG) ** 2
            kernels *= np.float32(1.0 - scatter.fraction)
            kernels += (scatter.per_sr(angle_deg) * pixel_sr).astype(np.float32)
        own = {"y_arcmin": -along, "x_arcmin": along}
        lit = _light(white_light, apodization, straylight=straylight)
        return result_of(grid, kernels, own, "light_ratio", notes, fixed=lit)

    def otf(
        self,
        *,
        frequency_cpd: ArrayLike = FREQUENCY_CPD,
        orientation_deg: ArrayLike = 0.0,
        white_light: bool = False,
        stiles_crawford: bool = False,
        straylight: bool = False,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return the complex optical transfer function.

        It is the Fourier transform of the PSF about the chief ray, with the kernel
        exp(-2 pi i f (x cos + y sin)).

        Parameters
        ----------
        frequency_cpd : float or (n,)
            Spatial frequencies, cycles per degree; in white light up to 60.
        orientation_deg : float or (m,)
            Directions in which the grating varies, counterclockwise: 0 for vertical
            bars, 90 for horizontal ones.
        white_light, stiles_crawford
            See `psf`.
        straylight : bool
            Whether to include the light that the media scatter.
        **states
            See `Eye`.
        """
        cpd = frequencies_cpd(frequency_cpd, white_light=white_light)
        angles = listed("orientation_deg", orientation_deg, (-360.0, 360.0))
        x_cpd, y_cpd = (
            np.multiply.outer(cpd, along(np.radians(angles)))
            for along in (np.cos, np.sin)
        )
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        apodization = self._apodization(stiles_crawford)

        def transfer(light: PupilLight) -> NDArray[Any]:
            found = light.transfer(white_light=white_light, stiles_crawford=apodization)
            return found.at(x_cpd, y_cpd).conj()

        values, notes = mapped(transfer, lights, x_cpd.shape, notes)
        if straylight:
            values = self._scattered(values, np.hypot(x_cpd, y_cpd))
        own = {"frequency_cpd": cpd, "orientation_deg": angles}
        lit = _light(white_light, apodization, straylight=straylight)
        return result_of(grid, values, own, "transfer_ratio", notes, fixed=lit)

    def mtf(
        self,
        *,
        frequency_cpd: ArrayLike = FREQUENCY_CPD,
        orientation_deg: ArrayLike | None = None,
        white_light: bool = False,
        stiles_crawford: bool = False,
        straylight: bool = False,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return the modulation transfer function.

        Parameters
        ----------
        frequency_cpd : float or (n,)
            Spatial frequencies, cycles per degree; in white light up to 60.
        orientation_deg : float or (m,), optional
            Orientations of gratings, see `otf`; by default, the mean of all.
        white_light, stiles_crawford, straylight
            See `otf`.
        **states
            See `Eye`.
        """
        options = {"white_light": white_light, "stiles_crawford": stiles_crawford}
        if orientation_deg is not None:
            found = self.otf(
                frequency_cpd=frequency_cpd,
                orientation_deg=orientation_deg,
                straylight=straylight,
                **options,
                **states,
            )
            return replace(found, values=np.abs(found.values), name="modulation_ratio")
        cpd = frequencies_cpd(frequency_cpd, white_light=white_light)
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        apodization = self._apodization(stiles_crawford)

        def modulation(light: PupilLight) -> NDArray[Any]:
            found = light.untilted.transfer(
                white_light=white_light, stiles_crawford=apodization
            )
            return found.modulation(cpd).reshape(cpd.shape)

        values, notes = mapped(modulation, lights, cpd.shape, notes)
        if straylight:
            values = self._scattered(values, cpd)
        own = {"frequency_cpd": cpd}
        lit = _light(white_light, apodization, straylight=straylight)
        return result_of(grid, values, own, "modulation_ratio", notes, fixed=lit)

    def contrast_sensitivity(
        self,
        *,
        white_light: bool = True,
        **options: Any,
    ) -> LabeledArray:
        """Return the contrast sensitivity: the MTF times the neural sensitivity.

        The neural sensitivity is that of the fovea, from the Standard Spatial Observer
        of Watson & Ahumada (2005) and the mean MTF of eyes.

        Parameters
        ----------
        white_light : bool
            See `psf`.
        **options
            See `mtf`.
        """
        found = self.mtf(white_light=white_light, **options)
        dims = ("frequency_cpd",) if "frequency_cpd" in found.dims else ()
        sensitivity = neural_sensitivity(found.coords["frequency_cpd"])
        if dims and found.dims[-1] == "orientation_deg":
            sensitivity = sensitivity[:, None]
        return replace(
            found,
            values=found.values * sensitivity,
            name="contrast_sensitivity_ratio",
        )

    def encircled_energy(
        self,
        *,
        radius_arcmin: ArrayLike = RADIUS_ARCMIN,
        white_light: bool = False,
        stiles_crawford: bool = False,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return the share of the light within circles about the chief ray.

        Parameters
        ----------
        radius_arcmin : float or (n,)
            Radii of the circles.
        white_light, stiles_crawford
            See `psf`.
        **states
            See `Eye`.
        """
        radii = listed("radius_arcmin", radius_arcmin, (0.0, MAX_RADIUS_ARCMIN))
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        apodization = self._apodization(stiles_crawford)

        def within(light: PupilLight) -> NDArray[np.float64]:
            found = light.encircled_ratio(
                np.atleast_1d(radii),
                white_light=white_light,
                stiles_crawford=apodization,
            )
            return found.reshape(radii.shape)

        values, notes = mapped(within, lights, radii.shape, notes)
        own = {"radius_arcmin": radii}
        lit = _light(white_light, apodization)
        return result_of(grid, values, own, "light_ratio", notes, fixed=lit)

    def acuity(self, **states: Unpack[States]) -> LabeledArray:
        """Return visual acuity in white light and the visual Strehl ratio.

        The axis ``quantity`` has ``log_mar``, the acuity of an observer who reads
        letters through the optics with the nerves of the fovea, ``visual_strehl_ratio``
        (VSOTF) at ``wavelength_nm``, and ``retina_log_mar``, the limit by the density
        of retinal cells in this direction, which is worse off the axis.

        Parameters
        ----------
        **states
            See `Eye`.
        """
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        values, notes = mapped(acuity_of, lights, (len(ACUITY),), notes)
        retina = retina_log_mar(
            grid.flat["h_deg"], grid.flat["v_deg"], eye_side=self.profile.eye_side
        )
        values = np.concatenate([values, retina[:, None]], axis=1)
        own = {QUANTITY: np.array([*ACUITY, "retina_log_mar"])}
        return result_of(grid, values, own, "acuity", notes)

    def through_focus(
        self,
        *,
        defocus_dpt: ArrayLike = DEFOCUS_DPT,
        frequency_cpd: float = ISO_CPD,
        quantities: Sequence[str] = THROUGH_FOCUS,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return acuity, visual Strehl ratio and modulation through focus.

        Parameters
        ----------
        defocus_dpt : float or (n,)
            Vergence that is added in the entrance pupil.  It is positive for objects
            nearer than ``object_dpt``, as through a minus lens.
        frequency_cpd : float
            Spatial frequency of the modulation, mean over all orientations.
        quantities : list of str
            Of ``log_mar``, ``visual_strehl_ratio`` and ``modulation_ratio``; the first
            two take about ten times as long as the last one.
        **states
            See `Eye`.
        """
        for quantity in quantities:
            check_choice("quantities", quantity, THROUGH_FOCUS)
        limits = -MAX_DEFOCUS_DPT, MAX_DEFOCUS_DPT
        defoci = listed("defocus_dpt", defocus_dpt, limits)
        cpd = listed("frequency_cpd", float(frequency_cpd), (0.0, MAX_FREQUENCY_CPD))
        grid = self._focused(states)
        lights, notes = self._tracer.lights(grid)
        moved = [
            light.with_defocus_dpt(defocus)
            for light in lights
            for defocus in np.atleast_1d(defoci).tolist()
        ]

        def quality(light: PupilLight) -> NDArray[np.float64]:
            found = {}
            if set(quantities) & set(ACUITY):
                found = dict(zip(ACUITY, acuity_of(light).tolist(), strict=True))
            if "modulation_ratio" in quantities:
                transfer = light.untilted.transfer(
                    white_light=False, stiles_crawford=None
                )
                found["modulation_ratio"] = transfer.modulation(cpd).item()
            return np.array([found[quantity] for quantity in quantities])

        values, notes = mapped(quality, moved, (len(quantities),), notes)
        values = values.reshape(grid.count, *defoci.shape, len(quantities))
        own = {"defocus_dpt": defoci, QUANTITY: np.array(quantities)}
        at = {"frequency_cpd": cpd} if "modulation_ratio" in quantities else {}
        return result_of(grid, values, own, "through_focus", notes, fixed=at)

    def refraction(
        self,
        *,
        method: str = "least_squares",
        vertex_mm: float = 0.0,
        **states: Unpack[States],
    ) -> LabeledArray:
        """Return the refraction: the lens that corrects the eye for infinity.

        The axis ``quantity`` has sphere, minus cylinder and axis as the examiner writes
        them, and the power vector M, J0 and J45 in the eye's frame, where J45 has the
        opposite sign.  A correction in the profile is worn: the result is what it
        lacks.

        Parameters
        ----------
        method : {"least_squares", "visual_strehl"}
            The lens that makes the wavefront as flat as possible, or the one with the
            highest visual Strehl ratio.
        vertex_mm : float
            Distance of the lens from the cornea.
        **states
            See `Eye`, without ``object_dpt``.
        """
        check_choice("method", method, REFRACTION_METHODS)
        vertex = listed("vertex_mm", float(vertex_mm), (0.0, 50.0))
        grid = state_grid(states, without=("object_dpt",))
        lights, notes = self._tracer.lights(grid)
        depth_mm = self._tracer.entrance_pupil_mm

        def lens(light: PupilLight) -> NDArray[np.float64]:
            return lens_of(
                light.at_cornea(depth_mm),
                is_sharpest=method == "visual_strehl",
                vertex_mm=float(vertex),
            )

        values, notes = mapped(lens, lights, (len(REFRACTION),), notes)
        own = {QUANTITY: np.array(REFRACTION)}
        at = {"vertex_mm": vertex}
        return result_of(grid, values, own, "refraction", notes, fixed=at)

    def _focused(self, states: States) -> StateGrid:
        """Return states whose default focus is infinity, not the relaxed eye."""
        if states.get("focus_dpt") is None and self.profile.surfaces is None:
            states = {**states, "focus_dpt": 0.0}
        return state_grid(states)

    def _apodization(self, is_on: bool) -> StilesCrawford | None:
        return self.stiles_crawford if is_on else None

    def _scattered(
        self, values: NDArray[Any], frequency_cpd: NDArray[np.float64]
    ) -> NDArray[Any]:
        """Return transfers of the optics with the light that the media scatter."""
        scatter = self.straylight
        return (1.0 - scatter.fraction) * values + scatter.transfer_ratio(frequency_cpd)


def _light(
    white_light: bool, apodization: StilesCrawford | None, *, straylight: bool = False
) -> dict[str, NDArray[Any]]:
    """Return coordinates for what is not plain light of one wavelength."""
    texts = {}
    if white_light:
        texts["light"] = "white"
        apodization = StilesCrawford()
    if apodization is not None:
        is_centered = apodization.centre_mm == (0.0, 0.0)
        texts["stiles_crawford"] = "centered" if is_centered else "decentered"
    if straylight:
        texts["straylight"] = "included"
    return {name: np.array(text) for name, text in texts.items()}
