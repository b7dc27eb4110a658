"""The gradient of defocus at one distance: ours, optiland and DeepLens.

All have the same schematic eye, whose retina is farther back than its focus, the same
pupil and pixels.  What is differentiated is the light in the middle of the image of a
Gaussian blob, by the radius of the cornea.  Ours is one number of a derivative image of
`image_derivatives`; theirs is backward differentiation of the PSF's sum, weighted with
the blob.

optiland's PSF contains diffraction, as ours does; DeepLens's consists of rays.  The
references are differences in double precision: of PSFs by quadrature
(`tests.reference.psf_integral`) and of rays that are traced here.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.optics import pinhole
from estimator.profiles.parse import parse_profile
from filter_service import Camera, EyeFilter, FilterSettings, image_derivatives
from filter_service.filtering.derivatives import ACCURACIES
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from tests.benchmarks.peer_optiland import EYE, eye_request
from tests.benchmarks.peer_process import PeerProcess, require
from tests.reference.flat_image import derivative
from tests.reference.psf_integral import reference_kernel

SETTING = "light of a blob of 3 px, 41 px of 0.65 mrad, 4 mm"
SIDE_PX, PITCH_TANGENT, BLOB_PX = 41, 6.5e-4, 3.0
PUPIL_MM, RETINA_MM = 4.0, 24.22
WAVELENGTH_NM = 555.0
STEP_MM = 0.01
RAYS = 8192
"""Of DeepLens: its default is 16384 for a PSF."""

SETTINGS = FilterSettings(
    mode="on-axis",
    chromatic=False,
    pupil_range_mm=(PUPIL_MM, PUPIL_MM),
    focus_range_dpt=(0.0, 0.0),
    object_range_dpt=(0.0, 0.25),
)

PARAMETER = "profile.surfaces.0.radius_mm"


@dataclass(frozen=True)
class Gradient:
    """A gradient, its time after a warm-up, and what it should be.

    Attributes
    ----------
    value, expected : float
        Light per mm.
    """

    value: float
    expected: float
    taken_ms: float

    @property
    def error(self) -> float:
        """Relative error."""
        return abs(self.value / self.expected - 1.0)


def camera() -> Camera:
    """Return a camera whose middle pixel looks along the axis."""
    half = SIDE_PX / 2.0 * PITCH_TANGENT
    return Camera(SIDE_PX, SIDE_PX, (-half, half, half, -half))


def eye_profile(cornea_mm: float | None = None) -> dict:
    """Return the eye, with another radius of the cornea if one is given."""
    surfaces = parse_profile(EYE).surfaces.relaxed
    rows = [
        {
            "radius_mm": float(surface.radius_mm[0]),
            "conic_constant": surface.conic_constant,
            "z_mm": surface.z_mm,
            "medium_after": surface.medium_after,
        }
        for surface in surfaces.surfaces
    ]
    if cornea_mm is not None:
        rows[0]["radius_mm"] = cornea_mm
    return {
        "kind": "surfaces",
        "surfaces": rows,
        "stop_z_mm": surfaces.stop_z_mm,
        "retina": {"radius_mm": 12.0, "z_mm": RETINA_MM},
    }


def cornea_radius_mm() -> float:
    """Return the radius at which the gradient is taken."""
    return float(eye_profile()["surfaces"][0]["radius_mm"])


def blob() -> NDArray[np.float64]:
    """Return the profile (side,) of the blob, whose light is its outer product."""
    at = np.arange(SIDE_PX) - SIDE_PX // 2
    return np.exp(-(at**2) / (2.0 * BLOB_PX**2))


def expected_by_waves() -> float:
    """Return the gradient by quadrature of the wavefront of the traced eye."""
    spec = GridSpec(camera(), SETTINGS)
    zero = np.zeros(1)

    def light(cornea_mm: float) -> NDArray[np.float64]:
        eye = eye_for_spec(parse_profile(eye_profile(cornea_mm)), spec)[0]
        state = {
            "h_deg": zero,
            "v_deg": zero,
            "accommodation_dpt": zero,
            "wavelength_nm": zero + WAVELENGTH_NM,
            "pupil_diameter_mm": zero + PUPIL_MM,
        }
        total_dpt = eye.total_defocus_dpt(**state)
        found = eye.wavefronts(**state, total_defocus_dpt=total_dpt)
        kernel = reference_kernel(
            found.zernike_um[0],
            pupil_diameter_mm=float(found.circle_diameter_mm[0]),
            pupil_ellipse=found.pupil_ellipse[0],
            wavelength_nm=WAVELENGTH_NM,
            pixel_from_mrad=pinhole.pixel_from_mrad(
                0.0, 0.0, tangents=spec.camera.tangents, size_px=(SIDE_PX, SIDE_PX)
            ),
            radius_px=SIDE_PX // 2,
        )
        return blob() @ kernel @ blob() / kernel.sum()

    return float(derivative(light, cornea_radius_mm(), STEP_MM))


def expected_by_rays(pixel_mm: float) -> float:
    """Return the gradient of rays to a flat sensor, spread to the nearest pixels."""
    surfaces = eye_request(
        parse_profile(eye_profile()).surfaces.relaxed, WAVELENGTH_NM
    )["surfaces"]
    node, weight = np.polynomial.legendre.leggauss(400)
    heights_mm = PUPIL_MM / 2.0 * np.sqrt((node + 1.0) / 2.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 512, endpoint=False)
    at = np.arange(SIDE_PX) - SIDE_PX // 2

    def light(cornea_mm: float) -> NDArray[np.float64]:
        rows = [dict(surface) for surface in surfaces]
        rows[0]["radius_mm"] = cornea_mm
        spot_px = traced_heights(rows, heights_mm) / pixel_mm
        x, y = (spot_px[:, None] * f(angle) for f in (np.cos, np.sin))
        values = np.interp(x, at, blob()) * np.interp(y, at, blob())
        return weight / 2.0 @ values.mean(axis=1)

    return float(derivative(light, cornea_radius_mm(), STEP_MM))


def traced_heights(
    surfaces: list[dict], heights_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return heights on a flat sensor of rays that are parallel to the axis."""
    y, z = heights_mm.copy(), np.zeros_like(heights_mm)
    along, up = np.ones_like(y), np.zeros_like(y)
    index = 1.0
    for surface in surfaces:
        radius, k = surface["radius_mm"], surface["conic_constant"]
        # Newton's method for the ray's parameter at the conic y² + (1 + k) s² = 2 R s.
        t = (surface["z_mm"] - z) / along
        for _ in range(50):
            s, h = z + t * along - surface["z_mm"], y + t * up
            value = h**2 + (1.0 + k) * s**2 - 2.0 * radius * s
            slope = 2.0 * (h * up + ((1.0 + k) * s - radius) * along)
            t = t - value / slope
        z, y = z + t * along, y + t * up
        s = z - surface["z_mm"]
        normal = np.stack([(1.0 + k) * s - radius, y]) * -math.copysign(1.0, radius)
        normal /= np.linalg.norm(normal, axis=0)
        ratio = index / surface["index_after"]
        cosine = along * normal[0] + up * normal[1]
        bent = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine
        along = ratio * along + bent * normal[0]
        up = ratio * up + bent * normal[1]
        index = surface["index_after"]
    return y + (RETINA_MM - z) / along * up


def our_gradient(accuracy: str, expected: float) -> Gradient:
    """Return the gradient of `image_derivatives`."""
    profile = eye_profile()
    color = np.repeat(np.outer(blob(), blob())[..., None], 3, axis=2)
    color = color.astype(np.float32)
    depth_m = np.full((SIDE_PX, SIDE_PX), np.inf, np.float32)
    with EyeFilter(profile, camera(), SETTINGS) as eye_filter:

        def gradient() -> float:
            found = image_derivatives(
                *(eye_filter, color, depth_m, [PARAMETER]),
                pupil_diameter_mm=PUPIL_MM,
                focus_dpt=0.0,
                profile=profile,
                accuracy=accuracy,
            )
            return float(found[PARAMETER][SIDE_PX // 2, SIDE_PX // 2, 1])

        return _timed(gradient, expected)


def _timed(gradient: Callable[[], float], expected: float) -> Gradient:
    gradient()
    start_s = time.perf_counter()
    value = gradient()
    return Gradient(value, expected, 1e3 * (time.perf_counter() - start_s))


def _asked(script: str, package: str, **arguments) -> dict:
    """Return the answer of a peer to the request of a gradient."""
    require(package)
    require("torch")
    process = PeerProcess(Path(__file__).with_name(script))
    eye = parse_profile(eye_profile()).surfaces.relaxed
    try:
        process.write("blob.npy", blob())
        return process.ask(
            "gradient",
            eye=eye_request(eye, WAVELENGTH_NM),
            wavelength_nm=WAVELENGTH_NM,
            pupil_mm=PUPIL_MM,
            pitch=PITCH_TANGENT,
            **arguments,
        )
    finally:
        process.close()


def optiland_gradient(expected: float) -> Gradient:
    """Return the gradient of optiland's FFT PSF, by its torch backend in float64."""
    answer = _asked("peer_optiland_script.py", "optiland")
    return Gradient(answer["gradient"], expected, 1e3 * answer["seconds"])


def deeplens_gradient() -> Gradient:
    """Return the gradient of DeepLens's PSF of rays, in float32."""
    answer = _asked("peer_deeplens_script.py", "deeplens-core", rays=RAYS)
    expected = expected_by_rays(answer["pixel_mm"])
    return Gradient(answer["gradient"], expected, 1e3 * answer["seconds"])


def gradient_methods() -> list[tuple[str, Callable[[], Gradient], str, str]]:
    """Return the methods of the table.

    Returns
    -------
    list of (name, gradient, reference, differs)
        The gradient raises `NotInstalled`; the others say what its error is measured
        against, and what it does otherwise or more.
    """
    expected, waves = expected_by_waves(), "quadrature of the PSF"
    whole = "the derivative of a whole image, in three equal colors"
    more = "Does more: gradients by all parameters of a lens at once"
    return [
        *(
            (f"ours, {name}", partial(our_gradient, name, expected), waves, whole)
            for name in ACCURACIES
        ),
        (
            "optiland FFTPSF",
            partial(optiland_gradient, expected),
            waves,
            f"one color, float64. {more}. Backward differentiation by the position of "
            "the retina differs from differences of the same PSF",
        ),
        (
            "DeepLens GeoLens",
            deeplens_gradient,
            "rays traced in double precision",
            f"one color, no diffraction, {RAYS} random rays, float32. {more}",
        ),
    ]
