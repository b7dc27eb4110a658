"""How often images filtered by ray optics are better than `psf.switch` predicts."""

import numpy as np

from estimator.psf.compute import compute_psf_batch, plan_psfs
from estimator.psf.switch import predicted_psnr_db
from tests.numerical.psf_cases import filter_psnr_db, zernike_from_terms

PIXELS_MRAD = (0.499, 0.873, 1.295)
WAVELENGTHS_NM = (464.0, 549.0, 612.0)
WAVE_NUMBERS = (16.0, 400.0)


def _random_wavefront(rng, pupil_mm: float) -> np.ndarray:
    """Defocus, cylinders with a meridian in focus, coma, trefoil, higher orders."""
    area = (pupil_mm / 2.0) ** 2
    kind = rng.integers(0, 4)
    terms = {"2,0": rng.normal(0.0, 0.4) * area}
    if kind == 0:
        # x² = (Z(2,0) / sqrt(3) + Z(2,2) sqrt(2 / 3)) / 4 + constant
        height_um = rng.uniform(0.5, 4.0) * area / 2.0
        angle = rng.uniform(0.0, np.pi)
        terms = {
            "2,0": height_um / (4.0 * np.sqrt(3.0)),
            "2,2": height_um * np.cos(2.0 * angle) / (2.0 * np.sqrt(6.0)),
            "2,-2": height_um * np.sin(2.0 * angle) / (2.0 * np.sqrt(6.0)),
        }
    for n in range(3, 5 if kind < 3 else 7):
        for m in range(-n, n + 1, 2):
            terms[f"{n},{m}"] = rng.normal(0.0, 0.25 / n) * (kind > 0) * area / 4.0
    return zernike_from_terms(terms)


def sweep(count: int, image, seed: int = 5) -> np.ndarray:
    """(m, 3): predicted and measured PSNR of ray optics, and the wave number."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        pupil_mm = float(rng.uniform(2.0, 7.0))
        options = {
            "pupil_diameter_mm": pupil_mm,
            "wavelength_nm": float(rng.choice(WAVELENGTHS_NM)),
            "pixel_pitch_mrad": float(rng.choice(PIXELS_MRAD)),
            "max_radius_px": 400,
        }
        wavefront = _random_wavefront(rng, pupil_mm)[None]
        survey = plan_psfs(wavefront, **options).survey
        if not WAVE_NUMBERS[0] <= survey.wave_number[0] <= WAVE_NUMBERS[1]:
            continue
        options["radius_px"] = int(np.ceil(survey.blur_radius_px[0])) + 5
        rays, waves = (
            compute_psf_batch(wavefront, method=method, accuracy="fine", **options)[0]
            for method in ("geometric", "fourier")
        )
        measured_db = filter_psnr_db(
            image, rays.kernel.astype(np.float64), waves.kernel.astype(np.float64)
        )
        found.append((predicted_psnr_db(survey)[0], measured_db, survey.wave_number[0]))
    return np.array(found)


def print_sweep(found: np.ndarray) -> None:
    """Share above the prediction, and what a switch at each level would get."""
    above = found[:, 1] >= found[:, 0]
    print(f"{above.mean():.1%} of {len(found)} wavefronts filter better than predicted")
    print("switch at   taken    worst  1 in 100   below 50 dB")
    for level_db in (49.0, 50.0, 51.0, 52.0, 53.0, 54.0):
        taken = found[found[:, 0] >= level_db, 1]
        if taken.size:
            print(
                f"{level_db:>6.0f} dB {taken.size / len(found):>8.1%} "
                f"{taken.min():>7.1f} {np.percentile(taken, 1):>9.1f} "
                f"{(taken < 50.0).mean():>11.2%}"
            )
