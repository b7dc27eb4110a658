"""Shared by the PSF tests: wavefronts, a test image, error measures.

No tests here.  The wavefronts and where they come from: tests/data/psf_cases.json, and
psf_field_cases.json for traced eyes over the visual field.
"""

import hashlib
import json
import math
import os
from collections import OrderedDict
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import scipy.fft
from PIL import Image, ImageDraw, ImageFont

from estimator.optics.pinhole import pixel_from_mrad
from estimator.optics.zernike import index_from_nm, remove_central_tilt, rescale_pupil
from estimator.psf.arguments import checked_scale
from estimator.psf.compute import plan_psfs
from estimator.psf.kernel_types import disc_mask
from estimator.psf.survey import RADIUS_LIMIT_PX
from tests.reference import psf_integral as psf_reference
from tests.reference.psf_integral import reference_kernel

CASES = json.loads(
    (Path(__file__).parents[1] / "data" / "psf_cases.json").read_text(encoding="utf-8")
)
CASE_NAMES = tuple(CASES["cases"])
FIELD_CASES = json.loads(
    (Path(__file__).parents[1] / "data" / "psf_field_cases.json").read_text("utf-8")
)
EYE_NAMES = tuple(FIELD_CASES["eyes"])
ECCENTRICITIES_DEG = {(0, 0): 0, (16, 12): 20, (33, 24): 40}
DENSITIES_MRAD = CASES["pixel_pitch_mrad"]
KEPT_REFERENCES = Path(__file__).parents[2] / "out" / "psf_references"
PUPILS_MM = tuple(CASES["pupil_diameters_mm"])
N_REMEMBERED = 16
_remembered: OrderedDict[tuple, np.ndarray] = OrderedDict()


def zernike_from_terms(terms: dict[str, float]) -> np.ndarray:
    zernike_um = np.zeros(28)
    for key, value in terms.items():
        zernike_um[index_from_nm(*map(int, key.split(",")))] = value
    return zernike_um


def case_zernike_um(name: str, pupil_diameter_mm: float) -> np.ndarray:
    """Coefficients (28,) of a case on the given pupil, chief ray at zero slope."""
    zernike_um = zernike_from_terms(CASES["cases"][name]["zernike_um"])
    ratio = pupil_diameter_mm / CASES["zernike_diameter_mm"]
    return remove_central_tilt(rescale_pupil(zernike_um, radius_ratio=ratio))


def configurations() -> list[tuple[str, float, float]]:
    """(case, pupil_mm, wavelength_nm): four pupils at 550 nm, and 450 and 650 nm."""
    rows = [(name, d, 550.0) for name in CASE_NAMES for d in PUPILS_MM]
    rows += [(name, 5.0, w) for name in CASE_NAMES for w in (450.0, 650.0)]
    return rows + [(name, 2.0, 650.0) for name in CASE_NAMES]


@dataclass(frozen=True)
class FieldCase:
    """One traced eye, direction, pupil and pixel size, as the PSF engines take it."""

    eye: str
    eccentricity_deg: int
    pupil_diameter_mm: float
    density: str
    zernike_um: np.ndarray
    options: dict

    def __str__(self):
        return (
            f"{self.eye}-{self.eccentricity_deg}deg-{self.pupil_diameter_mm:g}mm-"
            f"{self.density}"
        )


def field_case(eye, eccentricity_deg, pupil_diameter_mm, density) -> FieldCase:
    """Look a case up; its Jacobian is that of a pinhole with this pixel at its axis."""
    for row in FIELD_CASES["eyes"][eye]:
        place = ECCENTRICITIES_DEG[row["h_deg"], row["v_deg"]]
        if (place, row["pupil_diameter_mm"]) == (eccentricity_deg, pupil_diameter_mm):
            break
    else:
        raise KeyError(eye, eccentricity_deg, pupil_diameter_mm)
    side_px = 2000.0 / DENSITIES_MRAD[density]
    jacobian = pixel_from_mrad(
        row["h_deg"], row["v_deg"], tangents=(-1, 1, 1, -1), size_px=(side_px, side_px)
    )
    options = {
        "pupil_diameter_mm": 2.0 * row["zernike_radius_mm"],
        "wavelength_nm": FIELD_CASES["wavelength_nm"],
        "pupil_ellipse": np.array(row["ellipse_mm"]),
        "pixel_from_mrad": jacobian,
    }
    return FieldCase(
        eye,
        eccentricity_deg,
        pupil_diameter_mm,
        density,
        np.array(row["zernike_um"]),
        options,
    )


def field_cases() -> list[FieldCase]:
    """Six eyes x 0, 20 and 40 degrees x pupils of 2 to 7 mm x three pixel sizes."""
    return [
        field_case(eye, degrees, pupil_mm, density)
        for density in DENSITIES_MRAD
        for eye in EYE_NAMES
        for degrees in ECCENTRICITIES_DEG.values()
        for pupil_mm in (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    ]


def compared_radius_px(blur_radius_px: float) -> int:
    """Radius on which a kernel is compared: the spot and the Airy rings around it."""
    return int(np.ceil(blur_radius_px)) + 5


@lru_cache(maxsize=N_REMEMBERED)
def truth(
    name: str, pupil_mm: float, wavelength_nm: float, pitch_mrad: float, radius_px: int
) -> np.ndarray:
    """Return the reference of a case, read-only; the last ones are remembered."""
    kernel = reference_kernel(
        case_zernike_um(name, pupil_mm),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch_mrad,
        radius_px=radius_px,
    )
    kernel.flags.writeable = False
    return kernel


@dataclass(frozen=True)
class Window:
    """Square of pixels about a spot: the spot and the Airy rings around it.

    ``center_px``: x right, y up, whole pixels from the chief ray.
    """

    center_px: tuple[int, int]
    radius_px: int

    @classmethod
    def of_spot(cls, zernike_um: np.ndarray, options: dict) -> "Window":
        """Off axis the chief ray is not the middle of the spot."""
        survey = plan_psfs(
            zernike_um[None], max_radius_px=RADIUS_LIMIT_PX, **options
        ).survey
        middle = (survey.slope_low_px[0] + survey.slope_high_px[0]) / 2.0
        x, y = np.rint(middle).astype(int).tolist()
        half_px = float(survey.extent_px.max()) / 2.0
        return cls((x, y), compared_radius_px(half_px + 0.5))

    def cut(self, psf) -> np.ndarray:
        """Shares of the whole light in the window of a PSF, float64."""
        x, y = self.center_px
        room = max(0, max(abs(x), abs(y)) + self.radius_px - psf.radius_px)
        kernel = psf.kernel.astype(np.float64) * (1.0 - psf.lost_energy_ratio)
        kernel, middle = np.pad(kernel, room), psf.radius_px + room
        rows = slice(middle - y - self.radius_px, middle - y + self.radius_px + 1)
        return kernel[rows, middle + x - self.radius_px :][:, : 2 * self.radius_px + 1]

    def reference(self, zernike_um: np.ndarray, options: dict) -> np.ndarray:
        """Reference in the window, which whole pixels of tilt bring to the middle.

        The last ones are remembered.
        """
        key = (
            self,
            *(
                (name, np.ndarray.tobytes(value) if np.ndim(value) else value)
                for name, value in sorted(
                    (options | {"zernike_um": zernike_um}).items()
                )
            ),
        )
        if key not in _remembered:
            _remembered[key] = self._reference(zernike_um, options)
            _remembered[key].flags.writeable = False
            if len(_remembered) > N_REMEMBERED:
                _remembered.popitem(last=False)
        return _remembered[key]

    def _reference(self, zernike_um: np.ndarray, options: dict) -> np.ndarray:
        jacobian = checked_scale(
            options.get("pixel_pitch_mrad"), options.get("pixel_from_mrad"), 1
        )[0]
        shift_mrad = np.linalg.solve(jacobian, self.center_px)
        zernike_um = np.array(zernike_um)
        # W = 2 C(1,1) x + 2 C(1,-1) y on the unit circle.
        zernike_um[[2, 1]] -= shift_mrad * options["pupil_diameter_mm"] / 4.0
        return reference_kernel(zernike_um, radius_px=self.radius_px, **options)

    def kept_reference(self, zernike_um: np.ndarray, options: dict) -> np.ndarray:
        """Return the reference, computed once and kept under out/."""
        source = Path(psf_reference.__file__).read_bytes()
        digest = hashlib.sha256(source + repr(self).encode())
        for part in (zernike_um, *(options[name] for name in sorted(options))):
            digest.update(np.asarray(part, np.float64).tobytes())
        path = KEPT_REFERENCES / f"{digest.hexdigest()[:24]}.npy"
        if path.is_file():
            return np.load(path)
        kernel = self.reference(zernike_um, options)
        KEPT_REFERENCES.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.npy")
        np.save(part, kernel)
        part.replace(path)
        return kernel


def physical_kernel(psf, radius_px: int) -> np.ndarray:
    """Shares of the whole light in the middle (2r+1)² of a PSF, float64."""
    kernel = psf.kernel.astype(np.float64) * (1.0 - psf.lost_energy_ratio)
    if radius_px > psf.radius_px:
        return np.pad(kernel, radius_px - psf.radius_px)
    inner = slice(psf.radius_px - radius_px, psf.radius_px + radius_px + 1)
    return kernel[inner, inner]


def kernel_errors(kernel: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Relative L2 error and energy error inside the disc of the reference's array."""
    disc = disc_mask(reference.shape[0] // 2)
    difference = (kernel - reference)[disc]
    l2 = float(np.linalg.norm(difference) / np.linalg.norm(reference[disc]))
    return l2, float(difference.sum())


def _smooth_noise(rng: np.random.Generator, size_px: int) -> np.ndarray:
    """Noise with the 1/f amplitude spectrum of photographs, in 0..1."""
    frequency = np.hypot(np.fft.fftfreq(size_px)[:, None], np.fft.fftfreq(size_px))
    frequency[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((size_px, size_px))) / frequency
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return np.clip(0.35 + 0.18 * noise / noise.std(), 0.0, 1.0)


@cache
def make_test_image(size_px: int = 512) -> np.ndarray:
    """(512, 512) float64 linear, peak 1: photo-like, black text on white, small marks.

    The upper half is 1/f noise with hard-edged objects, the lower left text, the lower
    right marks of 1 to 3 px, white on black: the hardest content for a PSF's tails.
    The array is shared and read-only.
    """
    rng = np.random.default_rng(20)
    half = size_px // 2
    image = _smooth_noise(rng, size_px)
    for _ in range(24):
        y, x = rng.integers(0, half - 24), rng.integers(0, size_px - 48)
        h, w = rng.integers(6, 24), rng.integers(6, 48)
        image[y : y + h, x : x + w] = rng.uniform()
    page = Image.new("L", (half, half), 255)
    draw = ImageDraw.Draw(page)
    for row, size in enumerate((10, 11, 12, 14, 16, 20, 26, 32)):
        font = ImageFont.load_default(size)
        draw.text((4, 4 + 30 * row), "The quick brown fox 0123", font=font, fill=0)
    image[half:, :half] = (np.asarray(page) / 255.0) ** 2.2
    marks = np.zeros((half, half))
    for y in range(6, half - 6, 12):
        for x in range(6, half - 6, 12):
            h, w = rng.integers(1, 4, 2)
            marks[y : y + h, x : x + w] = 1.0
    image[half:, half:] = marks
    image.flags.writeable = False
    return image


def filter_psnr_db(image: np.ndarray, kernel: np.ndarray, reference: np.ndarray):
    """PSNR (peak 1) between the image filtered with each kernel, both at unit sum."""
    return filter_psnrs_db(image, kernel, reference, is_srgb=False)[0]


def filter_psnrs_db(image, kernel, reference, *, is_srgb=True) -> tuple[float, float]:
    """PSNR in linear light, and after sRGB encoding (nan if not asked for)."""
    kernels = (kernel / kernel.sum(), reference / reference.sum())
    size = scipy.fft.next_fast_len(image.shape[0] + kernel.shape[0])
    spectrum = scipy.fft.rfft2(image, (size, size))
    half = kernel.shape[0] // 2

    def filtered(part):
        part = scipy.fft.irfft2(spectrum * scipy.fft.rfft2(part, (size, size)))
        return part[half : half + image.shape[0], half : half + image.shape[1]]

    def psnr_db(error):
        return float(-10.0 * np.log10(max(np.mean(error**2), 1e-30)))

    linear_db = psnr_db(filtered(kernels[0] - kernels[1]))
    if not is_srgb:
        return linear_db, math.nan
    seen, true = (encode_srgb(filtered(k)) for k in kernels)
    return linear_db, psnr_db(seen - true)


def encode_srgb(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0.0, 1.0)
    bright = 1.055 * np.maximum(light, 1e-9) ** (1.0 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, bright)
