"""Light of one wavefront in the pupil, of one wavelength or white.

White light consists of the wavelengths of `WHITE_LIGHT`.  They are out of focus by the
longitudinal chromatic aberration of the Indiana Eye, and attenuated by the centered
Stiles-Crawford effect, as in `white_light_transfer`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from estimator.acuity.best_correction import best_correction_um
from estimator.acuity.predict import TILTS, Acuity, predict_acuity
from estimator.acuity.transfer import (
    FREQUENCY_STEP_CPD,
    WHITE_LIGHT,
    SteepWavefront,
    Transfer,
    optical_transfer,
    white_light_transfer,
)
from estimator.corrections.rings import Rings
from estimator.field.field_table import at_cornea_um
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.vergence import chromatic_refraction_dpt
from estimator.psf.compute import PsfBatch, compute_psf_batch
from estimator.psf.fourier import FftTooLong
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.threads import thread_count
from estimator.wavefront.field_wavefronts import FieldWavefronts

ACUITY = ("log_mar", "visual_strehl_ratio")
REFRACTION = ("sphere_dpt", "cylinder_dpt", "axis_deg", "M_dpt", "J0_dpt", "J45_dpt")

MAX_PSF_RADIUS_PX = 1023

MAX_THREADS = 8
"""Transfer functions take up to 0.5 GB per thread."""


@dataclass(frozen=True)
class PupilLight:
    """The wavefront of a point, and the pupil.

    Attributes
    ----------
    zernike_um : (n_terms,)
        Coefficients in the plane of the entrance pupil, on the circle about the chief
        ray that encloses the pupil.
    zernike_radius_mm : float
        Radius of the circle.
    pupil_ellipse : (5,)
        Center x, y and semi-axes, mm, and angle, rad.
    wavelength_nm : float
    rings : Rings or None
        Lens with several foci, or lenslets, as seen from the direction of the point.
    """

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    rings: Rings | None = None

    @property
    def _pupil(self) -> dict[str, Any]:
        rings = self.rings
        if rings is not None and rings.is_clear(self.zernike_radius_mm):
            rings = None
        return {
            "zernike_radius_mm": self.zernike_radius_mm,
            "wavelength_nm": self.wavelength_nm,
            "pupil_ellipse": self.pupil_ellipse,
            "pupil_screen": rings,
        }

    @property
    def untilted(self) -> PupilLight:
        """The same light with its image centered, which modulation does not depend on.

        A tilt requires finer samples.
        """
        zernike_um = self.zernike_um.copy()
        zernike_um[TILTS] = 0.0
        return replace(self, zernike_um=zernike_um)

    def with_defocus_dpt(self, defocus_dpt: float) -> PupilLight:
        """Return the light of an object that is nearer by a vergence in the pupil."""
        zernike_um = self.zernike_um.copy()
        zernike_um[rx.C20] -= defocus_dpt * self.zernike_radius_mm**2 / SPHERE_PER_C20
        return replace(self, zernike_um=zernike_um)

    def at_cornea(self, entrance_pupil_mm: float) -> PupilLight:
        """Return the light in the plane of the cornea, as instruments report it."""
        waves = FieldWavefronts(
            self.zernike_um[None],
            np.array([2.0 * self.zernike_radius_mm]),
            self.pupil_ellipse[None],
        )
        zernike_um = at_cornea_um(waves, entrance_pupil_mm=entrance_pupil_mm)[0]
        return replace(self, zernike_um=zernike_um)

    def best_corrected_um(self) -> NDArray[np.float64]:
        """Return the wavefront with the sphere and cylinder of best visual Strehl."""
        return best_correction_um(self.zernike_um, **self._pupil)

    def colors(self, *, white_light: bool) -> Iterator[tuple[float, PupilLight]]:
        """Yield weight and light of each wavelength: of white light, or one."""
        if not white_light:
            yield 1.0, self
            return
        own_dpt = chromatic_refraction_dpt(self.wavelength_nm)
        for wavelength_nm, weight in WHITE_LIGHT.items():
            shift_dpt = chromatic_refraction_dpt(wavelength_nm) - own_dpt
            shifted = self.with_defocus_dpt(shift_dpt)
            yield weight, replace(shifted, wavelength_nm=wavelength_nm)

    def acuity(self) -> Acuity:
        """Return the acuity in white light and the visual Strehl ratio."""
        return predict_acuity(self.zernike_um, **self._pupil)

    def transfer(
        self, *, white_light: bool, stiles_crawford: StilesCrawford | None
    ) -> Transfer:
        """Return the optical transfer function.

        Raises
        ------
        SteepWavefront
            The wavefront is too steep to be sampled.
        ValueError
            The pupil is covered by lenslets.
        """
        if white_light:
            # With the coarser steps of acuity, the modulation is off by up to 0.007.
            return white_light_transfer(
                self.zernike_um, **self._pupil, frequency_step_cpd=FREQUENCY_STEP_CPD
            )
        return optical_transfer(
            self.zernike_um, **self._pupil, stiles_crawford=stiles_crawford
        )

    def encircled_ratio(
        self,
        radius_arcmin: NDArray[np.float64],
        *,
        white_light: bool,
        stiles_crawford: StilesCrawford | None,
    ) -> NDArray[np.float64]:
        """Return the share (n,) of the light within radii (n,) about the chief ray."""
        found = np.zeros(radius_arcmin.shape)
        for weight, light in self.colors(white_light=white_light):
            transfer = optical_transfer(
                light.zernike_um,
                **light._pupil,
                stiles_crawford=StilesCrawford() if white_light else stiles_crawford,
            )
            found += weight * encircled_ratio(transfer, radius_arcmin)
        return found


def encircled_ratio(
    transfer: Transfer, radius_arcmin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share (n,) of the light within circles of radii (n,).

    Parameters
    ----------
    transfer : Transfer
        Up to the cutoff of the pupil.

    Notes
    -----
    The transform of a disc with radius r is r J1(2 pi r f) / f.  Its product with the
    transfer function is summed over the grid of frequencies, which is exact but for
    light at distances of the inverse of the frequency step, 3 deg.
    """
    steps = transfer.frequency_cpd.size // 2
    step_cpd = float(np.diff(transfer.frequency_cpd[steps : steps + 2]).item())
    along = np.arange(-steps, steps + 1)
    square = (along[:, None] ** 2 + along**2).ravel()
    # Equal radii once: an eighth of the Bessel functions.
    by_square = np.bincount(square, weights=transfer.transfer_ratio.real.ravel())
    rings = np.flatnonzero(by_square)[1:]
    cpd = step_cpd * np.sqrt(rings)
    sums = transfer.edge_ratio * by_square[rings]
    found = []
    for radius_deg in (radius_arcmin / 60.0).tolist():
        disc = radius_deg * j1(2.0 * np.pi * radius_deg * cpd) / cpd
        found.append(step_cpd**2 * (np.pi * radius_deg**2 + float(disc @ sums)))
    return np.array(found)


def psf_batches(
    lights: Sequence[PupilLight], *, white_light: bool, **options: Any
) -> list[tuple[float, dict[str, Any]]]:
    """Return weight and arguments of `compute_psf_batch` for each wavelength."""
    if white_light:
        options["stiles_crawford"] = StilesCrawford()
    colors = zip(
        *(light.colors(white_light=white_light) for light in lights), strict=True
    )
    return [
        (
            color[0][0],
            {
                "zernike_um": np.stack([light.zernike_um for _, light in color]),
                "pupil_diameter_mm": np.array(
                    [2.0 * light.zernike_radius_mm for _, light in color]
                ),
                "wavelength_nm": np.array([light.wavelength_nm for _, light in color]),
                "pupil_ellipse": np.stack([light.pupil_ellipse for _, light in color]),
                "max_radius_px": MAX_PSF_RADIUS_PX,
                **options,
            },
        )
        for color in colors
    ]


def finest_psfs(zernike_um: NDArray[np.float64], **options: Any) -> PsfBatch:
    """Compute PSFs by wave optics, except for those too wide for it.

    The arguments are the same as for `compute_psf_batch`.
    """
    try:
        return compute_psf_batch(
            zernike_um, method="fourier", accuracy="finest", **options
        )
    except FftTooLong:
        return compute_psf_batch(zernike_um, accuracy="finest", **options)


def acuity_of(light: PupilLight) -> NDArray[np.float64]:
    """Return the quantities `ACUITY`, (2,)."""
    found = light.acuity()
    return np.array([found.log_mar, found.visual_strehl_ratio])


def lens_of(
    light: PupilLight, *, is_sharpest: bool, vertex_mm: float
) -> NDArray[np.float64]:
    """Return the quantities `REFRACTION`, (6,), of a wavefront at the cornea."""
    removed_um = light.zernike_um
    if is_sharpest:
        removed_um = removed_um - light.best_corrected_um()
    m, j0, j45 = rx.power_vector_from_zernike(
        removed_um, zernike_radius_mm=light.zernike_radius_mm
    )
    lens = rx.at_vertex(rx.prescription_from_power_vector(m, j0, j45), vertex_mm)
    m, j0, j45 = rx.power_vector(replace(lens, vertex_mm=0.0))
    return np.array([lens.sphere_dpt, lens.cylinder_dpt, lens.axis_deg, m, j0, j45])


def mapped(
    function: Callable[[PupilLight], NDArray[Any]],
    lights: Sequence[PupilLight],
    shape: tuple[int, ...],
    notes: tuple[str, ...],
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Return function values (n, ...) of lights (n,), NaN for wavefronts too steep."""

    def value(light: PupilLight) -> NDArray[Any]:
        try:
            return function(light)
        except SteepWavefront:
            return np.full(shape, np.nan)

    with ThreadPoolExecutor(min(thread_count(), MAX_THREADS)) as pool:
        values = np.stack([*pool.map(value, lights)])
    count = int(np.isnan(values.reshape(len(lights), -1)).all(axis=1).sum())
    if count:
        note = f"{count} of {len(lights)} wavefronts are too steep to be sampled: NaN"
        notes = (*notes, Note("steep_wavefronts", note, count=count))
    return values, notes
