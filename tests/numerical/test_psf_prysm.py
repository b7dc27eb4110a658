"""PSFs against prysm, a package that shares no code with this one."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

from estimator.psf.compute import compute_psfs
from tests.numerical.prysm_psf import (
    CASES,
    FROZEN,
    RADIUS_PX,
    kernel_of,
    prysm_kernel,
)
from tests.numerical.psf_cases import (
    kernel_errors,
    physical_kernel,
    zernike_from_terms,
)
from tests.reference.psf_integral import reference_kernel

KEPT = json.loads(FROZEN.read_text(encoding="utf-8"))

PRYSM_L2 = 2e-4
"""prysm samples the pupil at 768 points across: its rim errs by less than that."""


def _ids(case):
    return f"{case[0]}-{case[1]:g}mm"


def _fast_kernel(
    zernike_um, *, radius_px, accuracy="fine", method="fourier", **options
):
    psf = compute_psfs(zernike_um[None], accuracy=accuracy, method=method, **options)[0]
    return physical_kernel(psf, radius_px)


def test_the_kept_kernels_are_those_of_the_cases():
    kept = [(*row[:4], tuple(row[4]) if row[4] else None) for row in KEPT["cases"]]
    assert kept == list(CASES)


@pytest.mark.parametrize("index", range(len(CASES)), ids=map(_ids, CASES))
def test_prysm_computed_the_reference(index):
    kept = np.array(KEPT["kernels"][index])
    l2, energy = kernel_errors(kernel_of(CASES[index], reference_kernel), kept)
    assert l2 < PRYSM_L2
    assert abs(energy) < PRYSM_L2


@pytest.mark.parametrize(("accuracy", "limit"), [("normal", 2e-2), ("fine", 1e-2)])
@pytest.mark.parametrize("index", range(len(CASES)), ids=map(_ids, CASES))
def test_prysm_computed_what_the_wave_method_computes(index, accuracy, limit):
    def engine(zernike_um, **options):
        return _fast_kernel(zernike_um, accuracy=accuracy, **options)

    l2, energy = kernel_errors(
        kernel_of(CASES[index], engine), np.array(KEPT["kernels"][index])
    )
    assert l2 < limit
    assert abs(energy) < 2e-3


def test_prysm_computed_what_the_enz_series_computes():
    index = [case[:2] for case in CASES].index(("emmetropia", 3.0))

    def engine(zernike_um, pupil_ellipse, **options):
        return _fast_kernel(zernike_um, method="enz", **options)

    l2, _ = kernel_errors(
        kernel_of(CASES[index], engine), np.array(KEPT["kernels"][index])
    )
    assert l2 < 1e-2


def test_coma_points_where_prysm_says():
    """Only the right way round agrees: no mirror image, no turn."""
    index = [case[0] for case in CASES].index("keratoconus")
    kept = np.array(KEPT["kernels"][index])
    kernel = kernel_of(CASES[index], _fast_kernel)
    for turned in (kernel[::-1], kernel[:, ::-1], np.rot90(kernel, 2)):
        assert kernel_errors(turned, kept)[0] > 0.2


def test_prysm_computes_a_new_wavefront_alike(rng):
    if find_spec("prysm") is None:
        pytest.skip("extra `crosscheck` is not installed")
    terms = {
        f"{n},{m}": rng.normal(0.0, 0.25) for n in (2, 3) for m in range(-n, n + 1, 2)
    }
    options = {
        "pupil_diameter_mm": 2.5,
        "wavelength_nm": float(rng.uniform(460.0, 620.0)),
        "pixel_pitch_mrad": 1.0,
        "radius_px": RADIUS_PX,
        "pupil_ellipse": (0.0, 0.0, 1.25, 1.1, float(rng.uniform(0.0, 3.0))),
    }
    zernike_um = zernike_from_terms(terms)
    l2, _ = kernel_errors(
        reference_kernel(zernike_um, **options), prysm_kernel(zernike_um, **options)
    )
    assert l2 < PRYSM_L2
