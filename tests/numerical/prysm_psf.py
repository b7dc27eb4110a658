"""PSFs by prysm, an independent package: its Zernike terms and its propagation.

    python -m tests.numerical.prysm_psf     writes tests/data/prysm_psfs.json

prysm is no requirement of the tests but part of the extra `crosscheck`: its kernels are
kept in that file, and where it is installed a test computes new ones.
"""

import importlib
import json
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.numerical.psf_cases import case_zernike_um

FROZEN = Path(__file__).parents[1] / "data" / "prysm_psfs.json"
N_SAMPLES = 768
N_NODES = 14
RADIUS_PX = 6
_FINE = 8

CASES = (
    ("emmetropia", 3.0, 549.0, 1.295, None),
    ("astig3D", 2.0, 612.0, 0.873, None),
    ("keratoconus", 3.0, 549.0, 1.295, None),
    ("keratoconus", 2.0, 464.0, 0.499, (0.05, -0.03, 0.9, 0.65, 0.6)),
    ("periph40", 2.0, 549.0, 1.295, (0.0, 0.0, 1.0, 0.77, 0.5)),
    ("myopia4D", 2.0, 549.0, 0.873, None),
)
"""Wavefront, pupil (mm), wavelength (nm), pixel (mrad), pupil ellipse."""


def import_prysm():
    """Modules polynomials and propagation, or ImportError.

    prysm asks pkg_resources for its own version and nothing else: answered here.
    """
    name = "pkg_resources"
    stand_in = SimpleNamespace(
        get_distribution=lambda package: SimpleNamespace(version=version(package))
    )
    before = sys.modules.get(name)
    sys.modules[name] = stand_in
    try:
        return (
            importlib.import_module("prysm.polynomials"),
            importlib.import_module("prysm.propagation"),
        )
    finally:
        del sys.modules[name]
        if before is not None:
            sys.modules[name] = before


def _coverage(x_mm, y_mm, step_mm, ellipse):
    """Share of each square sample that lies inside an ellipse."""
    cx, cy, major, minor, angle = ellipse
    offset = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    total = np.zeros(np.broadcast_shapes(x_mm.shape, y_mm.shape))
    for a in offset:
        for b in offset:
            x, y = x_mm + a * step_mm - cx, y_mm + b * step_mm - cy
            along = (x * np.cos(angle) + y * np.sin(angle)) / major
            across = (y * np.cos(angle) - x * np.sin(angle)) / minor
            total += along**2 + across**2 < 1.0
    return total / _FINE**2


def prysm_kernel(
    zernike_um,
    *,
    pupil_diameter_mm,
    wavelength_nm,
    pixel_pitch_mrad,
    radius_px,
    pupil_ellipse,
):
    """(2R+1, 2R+1) shares of the whole light, image orientation.

    Gauss-Legendre nodes inside each pixel by shifts of the output grid.
    """
    polynomials, propagation = import_prysm()
    circle_mm = pupil_diameter_mm / 2.0
    ellipse = pupil_ellipse or (0.0, 0.0, circle_mm, circle_mm, 0.0)
    step_mm = 2.04 * circle_mm / N_SAMPLES
    # The sample in the middle is the origin; rows are y upward.
    axis = (np.arange(N_SAMPLES) - N_SAMPLES // 2) * step_mm
    x, y = np.meshgrid(axis, axis)
    names = [polynomials.ansi_j_to_nm(j) for j in range(28)]
    terms = polynomials.zernike_nm_sequence(
        names, np.hypot(x, y) / circle_mm, np.arctan2(y, x), norm=True
    )
    wavefront_nm = 1000.0 * sum(c * z for c, z in zip(zernike_um, terms, strict=True))
    amplitude = _coverage(x, y, step_mm, ellipse)
    pupil = propagation.Wavefront.from_amp_and_phase(
        amplitude, wavefront_nm, wavelength_nm / 1000.0, step_mm
    )
    node, weight = np.polynomial.legendre.leggauss(N_NODES)
    side = 2 * radius_px + 1
    kernel = np.zeros((side, side))
    # A focal length of 1 mm makes a um a mrad.
    for a, wa in zip(node, weight, strict=True):
        for b, wb in zip(node, weight, strict=True):
            shift = (a / 2.0 * pixel_pitch_mrad, b / 2.0 * pixel_pitch_mrad)
            field = pupil.focus_fixed_sampling(1.0, pixel_pitch_mrad, side, shift=shift)
            kernel += wa * wb / 4.0 * np.abs(field.data) ** 2
    # prysm scales a field so that |field|² is |sum|² (step x pixel / lambda)².
    return kernel[::-1] / amplitude.sum()


def kernel_of(case, kernel_function):
    """Kernel of one of `CASES` by prysm, or by whatever else takes the same."""
    name, pupil_mm, wavelength_nm, pitch_mrad, ellipse = case
    return kernel_function(
        case_zernike_um(name, pupil_mm),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch_mrad,
        radius_px=RADIUS_PX,
        pupil_ellipse=ellipse,
    )


def main():
    """Write prysm's kernels of the cases."""
    kernels = [kernel_of(case, prysm_kernel) for case in CASES]
    content = {
        "source": f"prysm {version('prysm')}, by python -m tests.numerical.prysm_psf",
        "cases": [list(case) for case in CASES],
        "kernels": [[[float(f"{v:.7g}") for v in row] for row in k] for k in kernels],
    }
    FROZEN.write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
