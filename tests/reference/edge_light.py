"""Exact light of a lamp around its spot by brute force, also for a part of a pupil."""

import dataclasses

import numpy as np

from filter_service.planning.grid import field_deg
from tests.reference import psf_integral

RIM_MM = 0.35
"""Width over which a hidden part of the pupil begins.  The rays of a pixel of 0.7 mrad
pass an edge at 2 dpt over this width."""


def lamp_light(
    store,
    x_px,
    y_px,
    *,
    pupil_mm,
    focus_dpt,
    object_dpt,
    radius_px,
    channel,
    cut_mm=None,
):
    """Return the share of a pixel's light (2R+1, 2R+1) that arrives in each pixel.

    Parameters
    ----------
    store : PsfStore
        The eye and camera; its kernels are not used.
    cut_mm : float, optional
        The pupil is hidden to the right of this position, x in mm.  The amplitude falls
        smoothly, because the diffraction at the edge of the object is not simulated.
    """
    eye, spec = store.eye, store.spec
    h_deg = v_deg = np.zeros(1)
    if spec.follows_field:
        at = np.array([x_px + 0.5]), np.array([y_px + 0.5])
        h_deg, v_deg = field_deg(spec.camera, *at, gaze_deg=spec.settings.gaze_deg)
    wavelength_nm = float(spec.channel_wavelengths_nm[channel])
    place = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "pupil_diameter_mm": np.array([pupil_mm]),
        "accommodation_dpt": np.array(
            [eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)]
        ),
        "wavelength_nm": np.array([wavelength_nm]),
    }
    total_dpt = eye.total_defocus_dpt(**place)
    total_dpt = total_dpt + eye.vergence.vergence_dpt(object_dpt)
    found = eye.wavefronts(**place, total_defocus_dpt=total_dpt)
    make_pupil = psf_integral._pupil
    if cut_mm is not None:
        psf_integral._pupil = lambda *given: _hidden(make_pupil(*given), cut_mm)
    try:
        return psf_integral.reference_kernel(
            found.zernike_um[0],
            pupil_diameter_mm=found.circle_diameter_mm[0],
            wavelength_nm=wavelength_nm,
            radius_px=radius_px,
            pixel_from_mrad=spec.pixel_from_mrad(h_deg, v_deg),
            pupil_ellipse=found.pupil_ellipse[0],
        )
    finally:
        psf_integral._pupil = make_pupil


def _hidden(pupil, cut_mm):
    """Return a pupil whose right part is hidden."""

    class Hidden(psf_integral._Pupil):
        def amplitude(self, x, y):
            u_mm = self.circle_point(x, y)[0] * self.circle_mm
            part = np.clip((u_mm - cut_mm) / RIM_MM / 1.5 + 0.5, 0.0, 1.0)
            part = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
            return super().amplitude(x, y) * np.cos(0.5 * np.pi * part)

    values = {f.name: getattr(pupil, f.name) for f in dataclasses.fields(pupil)}
    return Hidden(**values)


def ring_ratios(found, exact, is_outside, n_rings, n_sectors):
    """Return found over exact light (n_rings, n_sectors + 1) outside a spot.

    The last column is the whole ring.  Sectors of less than 6 pixels are NaN.
    """
    radius = found.shape[0] // 2
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    rho_px = np.hypot(x, y)
    sector = ((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * n_sectors).astype(int)
    sector %= n_sectors
    ends_px = np.geomspace(rho_px[is_outside].min(), radius, n_rings + 1)
    ratios = np.full((n_rings, n_sectors + 1), np.nan)
    for ring in range(n_rings):
        here = is_outside & (rho_px >= ends_px[ring] - 1e-9)
        here &= rho_px <= ends_px[ring + 1] + 1e-9
        for k in range(n_sectors + 1):
            own = here & (sector == k) if k < n_sectors else here
            if np.count_nonzero(own) >= 6:
                ratios[ring, k] = found[own].sum() / exact[own].sum()
    return ratios
