"""The main figure of each scenario, and an independent calculation of it.

Calculations use closed forms, sums over the pupil, or sums over the picture.  They take
numbers of the profile and, with an implant, the coefficients of the eye.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from clients.figures.defocus import added_power_dpt
from clients.scenarios import Scenario, scenario_view, scenarios
from estimator import Eye, load_profile
from estimator.profiles.bodies import PRESETS
from filter_service import Camera, EyeFilter, RgbdView
from tests.human_data import smith_log_mar

NM = 555.0
PUPIL_DEPTH_M = 3.05e-3
ROTATION_CENTER_M = 13.5e-3
IMPLANT_POWER_RATIO = (1.0 - 0.0046 / 1.3386 * 43.04) ** 2
"""Power of an implant in the pupil over that in its own plane, 4.6 mm deep."""

CPD = 12.0
VEIL_SIZE_PX = (480, 270)
PERIPHERY_DEG = 20.0


@dataclass(frozen=True)
class Figure:
    """A figure of a scenario: what it is, found and expected, and how far they may be.

    Attributes
    ----------
    scenario, name, unit : str
    found, expected : callables
    tolerance : float
        Largest difference, as the benchmark of that quantity states it.
    reference : str
        What the independent calculation is.
    """

    scenario: str
    name: str
    unit: str
    found: Callable[[], float]
    expected: Callable[[], float]
    tolerance: float
    reference: str


def figures() -> list[Figure]:
    """Return the main figure of each scenario."""
    return [
        Figure(
            *("reading", "acuity at 40 cm without addition", "logMAR"),
            *(reading_log_mar, smith_reading_log_mar, 0.1),
            "Smith 1991",
        ),
        Figure(
            *("cataract_monofocal", "straylight at 3 deg, log s", "log10"),
            *(lamp_log_s, cie_log_s, 0.02),
            "CIE 135/1-1999 and the stated log s",
        ),
        Figure(
            *("cataract_monofocal", "refraction after surgery", "dpt"),
            *(residual_dpt, asked_residual_dpt, 0.02),
            "what the profile asks for",
        ),
        Figure(
            *("cataract_edof", "contrast at 12 cpd and 1 m", "modulation"),
            *(edof_modulation, edof_sum, 0.02),
            "sum over the steps",
        ),
        Figure(
            *("cataract_trifocal", "contrast at 12 cpd and 40 cm", "modulation"),
            *(trifocal_modulation, trifocal_sum, 0.016),
            "sum over the steps",
        ),
        Figure(
            *("myopia_lenslets", "mean added power 20 deg aside", "dpt"),
            *(lenslets_dpt, lenslets_counted_dpt, 0.02),
            "points in lenslets, counted",
        ),
        Figure(
            *("myopia_soft_lens", "contrast at 12 cpd", "modulation"),
            *(soft_lens_modulation, soft_lens_sum, 0.005),
            "sum over the zones",
        ),
        Figure(
            *("keratoconus", "higher orders behind a rigid lens, 4 mm", "um RMS"),
            *(rigid_rms_um, tear_film_rms_um, 0.003),
            "indices of tears and cornea",
        ),
        Figure(
            *("astigmatism", "contrast of vertical bars, 6 cpd", "modulation"),
            *(astigmatic_modulation, hopkins_modulation, 0.002),
            "Hopkins 1955",
        ),
        Figure(
            *("night_driving", "veil on the person at the roadside", "cd/m²"),
            *(veil_cd_m2, veil_sum_cd_m2, 0.01),
            "sum over the picture, CIE 135/1-1999",
        ),
        Figure(
            *("night_trifocal", "light over 12 arcmin from a lamp", "ratio"),
            *(halo_ratio, halo_sum_ratio, 0.005),
            "sum over the steps",
        ),
        Figure(
            *("progressive_stairs", "refraction in the line of sight", "dpt"),
            *(stairs_dpt, corridor_dpt, 0.02),
            "normal distribution along the corridor",
        ),
    ]


# Sums over the pupil


def modulation_sum(
    wave_um: Callable[[NDArray, NDArray], NDArray], pupil_mm: float, cpd: float
) -> float:
    """Modulation of a grating along x: the overlap of two pupils, point by point."""
    shift_mm = NM * 1e-6 * math.degrees(1.0) * cpd
    x = ((np.arange(400) + 0.5) / 400 - 0.5) * pupil_mm
    x, y = np.meshgrid(x, x)
    ends = x - shift_mm / 2.0, x + shift_mm / 2.0
    inside = np.all([end**2 + y**2 <= pupil_mm**2 / 4.0 for end in ends], axis=0)
    step_um = wave_um(ends[1], y) - wave_um(ends[0], y)
    total = np.exp(2e3j * np.pi / NM * step_um)[inside].sum()
    return abs(total) / np.count_nonzero(x**2 + y**2 <= pupil_mm**2 / 4.0)


def at_pupil_dpt(power_dpt: float, distance_m: float) -> float:
    """Power of a lens in front of the pupil, as it acts there."""
    return power_dpt / (1.0 - distance_m * power_dpt)


def modulation_of(
    profile: Any, scenario: Scenario, *, cpd: float = CPD, **more: Any
) -> float:
    """Modulation by `Eye`, of what is looked at unless an object is stated."""
    states = {
        "pupil_diameter_mm": scenario.pupil_diameter_mm,
        "focus_dpt": scenario.focus_dpt,
        "object_dpt": scenario.focus_dpt,
        "wavelength_nm": NM,
    }
    found = Eye(dict(profile)).mtf(frequency_cpd=cpd, **{**states, **more})
    return float(found.values)


# Reading


def reading_log_mar() -> float:
    one = scenarios()["reading"]
    found = Eye(dict(one.a.profile)).acuity(
        pupil_diameter_mm=one.pupil_diameter_mm,
        focus_dpt=one.focus_dpt,
        object_dpt=one.focus_dpt,
    )
    return float(found.values[0])


def smith_reading_log_mar() -> float:
    one = scenarios()["reading"]
    return float(smith_log_mar(one.pupil_diameter_mm, one.focus_dpt))


# Straylight


def glare_per_sr(angle_deg: NDArray, *, age_years: float, log_s: float) -> NDArray:
    """CIE total glare function of a brown eye, with a stated log s at 7 degrees.

    The core, which the wavefront makes, is left out; it is below 2 % from 1 degree on.
    """

    def cie(angle_deg: Any) -> Any:
        square = np.square(angle_deg)
        age = (age_years / 70.0) ** 4
        core = 9.2e6 / (1.0 + square / 0.0046**2) ** 1.5
        core = core + 1.5e5 / (1.0 + square / 0.045**2) ** 1.5
        media = 400.0 / (1.0 + square / 0.01) + 3e-8 * square
        media = media + 0.5 * (
            1300.0 / (1.0 + square / 0.01) ** 1.5 + 0.8 / np.sqrt(1.0 + square / 0.01)
        )
        return (1.0 - 0.08 * age) * core + (1.0 + 1.6 * age) * media + 2.5e-3 * 0.5

    excess = 10.0**log_s - 49.0 * cie(7.0)
    angle_deg = np.maximum(angle_deg, 1e-6)
    outside_core = -np.expm1(-np.square(angle_deg / 0.5))
    return (cie(angle_deg) + excess / angle_deg**2) * outside_core


def lamp_log_s() -> float:
    """Straylight parameter of a filtered lamp, 3 degrees beside it."""
    body = dict(scenarios()["cataract_monofocal"].a.profile, yellowing=None)
    camera = Camera.from_fov(12.0, width_px=121, height_px=121)
    color = np.zeros((121, 121, 3), np.float32)
    color[60, 60] = 1e6
    view = RgbdView(color, np.full((121, 121), 6.0, np.float32), camera.tangents)
    with EyeFilter(body, camera, worker=False) as eye_filter:
        seen = eye_filter.filter(
            view, pupil_diameter_mm=2.7, focus_dpt=1 / 6, output="linear", whole=True
        )
    pitch = camera.pixel_pitch_mrad[0] / 1e3
    column = 60 + round(math.tan(math.radians(3.0)) / pitch)
    angle_deg = math.degrees(math.atan((column - 60) * pitch))
    light_per_sr = float(seen.color[60, column, 1]) / 1e6 / pitch**2
    # A pixel off the axis subtends less, and is as bright.
    return math.log10(light_per_sr * angle_deg**2)


def cie_log_s() -> float:
    one = scenarios()["cataract_monofocal"].a.profile
    log_s = one["straylight"]["log_s"]
    per_sr = glare_per_sr(np.array(3.0), age_years=one["age_years"], log_s=log_s)
    return math.log10(9.0 * float(per_sr))


# Implants


def residual_dpt() -> float:
    one = scenarios()["cataract_monofocal"]
    found = Eye(dict(one.b.profile)).refraction(pupil_diameter_mm=4.0, wavelength_nm=NM)
    return float(found.values[3])


def asked_residual_dpt() -> float:
    one = scenarios()["cataract_monofocal"]
    return float(one.b.profile["correction"]["residual_sphere_dpt"])


def implant_modulation(name: str, object_dpt: float) -> float:
    one = scenarios()[name]
    return modulation_of(
        one.b.profile, one, object_dpt=object_dpt, focus_dpt=0.0, orientation_deg=0.0
    )


def implant_wave(
    name: str, steps_um: Callable[[NDArray, Mapping], NDArray]
) -> Callable[[NDArray, NDArray], NDArray]:
    """Path through the eye of state B, whose lens has steps, by position in the pupil.

    Coefficients of an eye with rings are those of its distance focus.
    """
    one = scenarios()[name]
    pupil_mm = one.pupil_diameter_mm
    seen = Eye(dict(one.b.profile)).wavefront(
        plane="pupil", pupil_diameter_mm=pupil_mm, focus_dpt=0.0, wavelength_nm=NM
    )
    terms = [
        (n, m, float(seen.values[(n * (n + 2) + m) // 2]))
        for n in range(1, 7)
        for m in range(-n, n + 1, 2)
    ]
    lens = one.b.profile["correction"]

    def wave_um(x, y):
        square = x**2 + y**2
        rho, phi = 2.0 * np.sqrt(square) / pupil_mm, np.arctan2(y, x)
        eye_um = sum(c * zernike(n, m, rho, phi) for n, m, c in terms)
        return eye_um + steps_um(square, lens)

    return wave_um


def implant_sum(
    name: str, object_dpt: float, steps_um: Callable[[NDArray, Mapping], NDArray]
) -> float:
    """Sum over the pupil, with coefficients of the eye and the steps of its lens."""
    of_far_um = implant_wave(name, steps_um)

    def wave_um(x, y):
        return of_far_um(x, y) - object_dpt * (x**2 + y**2) / 2.0

    return modulation_sum(wave_um, scenarios()[name].pupil_diameter_mm, CPD)


def edof_modulation() -> float:
    return implant_modulation("cataract_edof", 1.0)


def edof_sum() -> float:
    """Steps of one and a half waves, whose first order is the far focus."""

    def steps_um(square_mm2, lens):
        add_dpt = lens["add_dpt"] * IMPLANT_POWER_RATIO
        periods = square_mm2 * add_dpt / 2.0 / 0.55
        return 0.55 * (1.5 * (periods % 1.0) - periods)

    return implant_sum("cataract_edof", 1.0, steps_um)


def trifocal_modulation() -> float:
    return implant_modulation("cataract_trifocal", 2.5)


def trifocal_um(square_mm2: NDArray, lens: Mapping[str, Any]) -> NDArray:
    """Steps of the trifocal implant, as deep as the search for the shares made them."""
    eye = {"kind": "prescription", "sphere_dpt": 0, "correction": dict(lens)}
    depth = np.array(load_profile(eye).correction.rings.kinoform.path_ratio)
    add_dpt = lens["adds_dpt"][0] * IMPLANT_POWER_RATIO
    periods = square_mm2 * add_dpt / 2.0 / 0.55
    return 0.55 * depth[(periods % 1.0 * depth.size).astype(int)]


def trifocal_sum() -> float:
    return implant_sum("cataract_trifocal", 2.5, trifocal_um)


CORE_ARCMIN = 12.0
"""Radius about a lamp that contains the light of the far and the intermediate focus."""

IMAGE_DEG = 8.0
"""Width of the image of a Fourier sum, for which the steps of the lens are sampled."""


def halo_ratio() -> float:
    one = scenarios()["night_trifocal"]
    found = Eye(dict(one.b.profile)).encircled_energy(
        radius_arcmin=[CORE_ARCMIN],
        pupil_diameter_mm=one.pupil_diameter_mm,
        focus_dpt=0.0,
        wavelength_nm=NM,
    )
    return 1.0 - float(found.values[0])


def halo_sum_ratio() -> float:
    """The same of a Fourier sum over the pupil, with the coefficients of the eye."""
    pupil_mm = scenarios()["night_trifocal"].pupil_diameter_mm
    step_mm, count = NM * 1e-6 / math.radians(IMAGE_DEG), 4096
    x = (np.arange(count) - count // 2) * step_mm
    x = x[np.abs(x) < pupil_mm / 2.0]
    x, y = np.meshgrid(x, x)
    wave_um = implant_wave("night_trifocal", trifocal_um)(x, y)
    field = np.exp(2e3j * np.pi / NM * wave_um) * (x**2 + y**2 < pupil_mm**2 / 4.0)
    light = np.abs(np.fft.fft2(field, (count, count))) ** 2
    square = np.square(np.fft.fftfreq(count) * IMAGE_DEG * 60.0)
    is_outside = np.add.outer(square, square) > CORE_ARCMIN**2
    return float(light[is_outside].sum() / light.sum())


# Lenses against myopia


def lenslets_dpt() -> float:
    one = scenarios()["myopia_lenslets"]
    profile = load_profile(dict(one.b.profile))
    found = added_power_dpt(
        profile,
        pupil_diameter_mm=one.pupil_diameter_mm,
        h_deg=np.array([PERIPHERY_DEG]),
        v_deg=np.array([0.0]),
    )
    return float(found[0])


def lenslets_counted_dpt() -> float:
    """Share of points of the pupil in one of 396 disks, over all honeycombs."""
    one = scenarios()["myopia_lenslets"]
    area_mm2 = math.pi * ((16.5 - 0.515) ** 2 - (4.7 + 0.515) ** 2) / 396
    pitch_mm = math.sqrt(area_mm2 * 2.0 / math.sqrt(3.0))
    chance = np.random.default_rng(3)
    radius_mm = one.pupil_diameter_mm / 2.0 * np.sqrt(chance.random(200_000))
    angle = 2.0 * np.pi * chance.random(200_000)
    # The light of this direction crosses the lens about this point.
    x = radius_mm * np.cos(angle) + 15.05 * math.tan(math.radians(PERIPHERY_DEG))
    y = radius_mm * np.sin(angle)
    row_mm = pitch_mm * math.sqrt(3.0) / 2.0
    covered = np.zeros(x.shape, bool)
    for row in range(-20, 21):
        for column in range(-20, 21):
            at = (column + row % 2 / 2.0) * pitch_mm, row * row_mm
            if 5.215 <= math.hypot(*at) <= 15.985:
                covered |= (x - at[0]) ** 2 + (y - at[1]) ** 2 <= 0.515**2
    return 3.5 * float(covered.mean())


def soft_lens_modulation() -> float:
    one = scenarios()["myopia_soft_lens"]
    return modulation_of({**one.b.profile, "higher_order": "none"}, one)


def soft_lens_sum() -> float:
    one = scenarios()["myopia_soft_lens"]
    lens = one.b.profile["correction"]
    far_dpt = lens["sphere_dpt"]
    edges = [0.0]
    for diameter_mm in lens["zone_diameters_mm"]:
        edges.append((diameter_mm / 2.0 * (1.0 - PUPIL_DEPTH_M * far_dpt)) ** 2)
    adds_dpt = [
        at_pupil_dpt(far_dpt + add, PUPIL_DEPTH_M)
        - at_pupil_dpt(far_dpt, PUPIL_DEPTH_M)
        for add in lens["zone_adds_dpt"]
    ]

    def wave_um(x, y):
        square = x**2 + y**2
        return sum(
            add / 2.0 * np.clip(square - low, 0.0, high - low)
            for add, low, high in zip(adds_dpt, edges[:-1], edges[1:], strict=True)
        )

    return modulation_sum(wave_um, one.pupil_diameter_mm, CPD)


# Corneas and spectacles


def rigid_rms_um() -> float:
    one = scenarios()["keratoconus"]
    found = Eye(dict(one.b.profile)).wavefront(
        pupil_diameter_mm=one.pupil_diameter_mm, wavelength_nm=NM
    )
    return float(np.linalg.norm(found.values[6:]))


def tear_film_rms_um() -> float:
    """Coefficients of the preset, what tears leave of them, and the lens's own."""
    one = scenarios()["keratoconus"]
    body = PRESETS["keratoconus"]
    left = (1.376 - 1.336) / (1.376 - 1.0)
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 101)]))
    rho, phi = np.hypot(x, y), np.arctan2(y, x)
    inside = rho <= 1.0
    rho, phi = rho[inside], phi[inside]
    ratio = one.pupil_diameter_mm / body["pupil_diameter_mm"]
    wave_um = sum(
        left * value * zernike(*map(int, term.split(",")), ratio * rho, phi)
        for term, value in body["zernike_um"].items()
    )
    lens_um = one.b.profile["correction"]["spherical_aberration_um"]
    wave_um = wave_um + lens_um * zernike(4, 0, one.pupil_diameter_mm / 6.0 * rho, phi)
    terms = [(n, m) for n in range(9) for m in range(-n, n + 1, 2)]
    basis = np.stack([zernike(n, m, rho, phi) for n, m in terms], axis=1)
    fitted = np.linalg.lstsq(basis, wave_um, rcond=None)[0]
    is_higher = np.array([n > 2 for n, _ in terms])
    return float(np.linalg.norm(fitted[is_higher]))


def zernike(n: int, m: int, rho: NDArray, phi: NDArray) -> NDArray:
    """OSA polynomial from the factorials of its definition."""
    radial = sum(
        (-1) ** k
        * math.factorial(n - k)
        / math.factorial(k)
        / math.factorial((n + abs(m)) // 2 - k)
        / math.factorial((n - abs(m)) // 2 - k)
        * rho ** (n - 2 * k)
        for k in range((n - abs(m)) // 2 + 1)
    )
    norm = math.sqrt((1 if m == 0 else 2) * (n + 1))
    return norm * radial * (np.cos(m * phi) if m >= 0 else np.sin(-m * phi))


def astigmatic_modulation() -> float:
    one = scenarios()["astigmatism"]
    return modulation_of(
        {**one.a.profile, "higher_order": "none"}, one, cpd=6.0, orientation_deg=0.0
    )


def hopkins_modulation() -> float:
    """The integral of defocus: only the meridian across the bars matters."""
    one = scenarios()["astigmatism"]
    vertex_m = one.a.profile["vertex_mm"] / 1e3 + PUPIL_DEPTH_M
    defocus_dpt = -at_pupil_dpt(one.a.profile["cylinder_dpt"], vertex_m) - one.focus_dpt
    pupil_mm = one.pupil_diameter_mm
    shift_mm = NM * 1e-6 * math.degrees(1.0) * 6.0
    half_mm = (pupil_mm - shift_mm) / 2.0
    x = (np.arange(4000) + 0.5) / 4000 * 2.0 * half_mm - half_mm
    chord_mm = 2.0 * np.sqrt(pupil_mm**2 / 4.0 - (np.abs(x) + shift_mm / 2.0) ** 2)
    wave = np.cos(2e3 * np.pi / NM * defocus_dpt * shift_mm * x)
    area_mm2 = math.pi * pupil_mm**2 / 4.0
    return abs(float((chord_mm * wave).sum()) * 2.0 * half_mm / 4000 / area_mm2)


def stairs_dpt() -> float:
    one = scenarios()["progressive_stairs"]
    found = Eye(dict(one.a.profile)).refraction(pupil_diameter_mm=4.0, wavelength_nm=NM)
    return float(found.values[3])


def corridor_dpt() -> float:
    one = scenarios()["progressive_stairs"]
    eye, lens = one.a.profile, one.a.profile["correction"]
    vertex_m = lens["vertex_mm"] / 1e3
    down_mm = (
        -1e3
        * (vertex_m + ROTATION_CENTER_M)
        * math.tan(math.radians(lens["gaze_deg"][1]))
    )
    half_mm = lens["corridor_mm"] / 2.0
    power_dpt = lens["sphere_dpt"] + lens["add_dpt"] * float(
        ndtr((down_mm - half_mm) / (half_mm / 2.0))
    )
    before_m = vertex_m + PUPIL_DEPTH_M
    lacking_dpt = at_pupil_dpt(eye["sphere_dpt"], before_m) - at_pupil_dpt(
        power_dpt, before_m
    )
    return lacking_dpt / (1.0 + PUPIL_DEPTH_M * lacking_dpt)  # at the cornea


# Glare at night


def _night() -> tuple[RgbdView, dict[str, Any], tuple[int, int]]:
    """Return the road, the profile with spectacles, and a pixel of the person."""
    one = scenarios()["night_driving"]
    view = scenario_view(one, VEIL_SIZE_PX)
    left, right, up, down = view.tangents
    column = (1.55 / 25.0 + 0.8 / 30.0 - left) / (right - left) * VEIL_SIZE_PX[0]
    row = (up - 0.0) / (up - down) * VEIL_SIZE_PX[1]
    return view, dict(one.b.profile), (round(row), round(column))


def veil_cd_m2() -> float:
    """Luminance at the person's head with straylight, less that without."""
    view, body, (row, column) = _night()
    one = scenarios()["night_driving"]
    found = []
    for profile in (body, {**body, "straylight": None}):
        with EyeFilter(profile, view.camera, worker=False) as eye_filter:
            seen = eye_filter.filter(
                view,
                pupil_diameter_mm=one.pupil_diameter_mm,
                focus_dpt=one.focus_dpt,
                output="linear",
                whole=True,
            )
        found.append(seen.color[row, column].astype(float))
    return float((found[0] - found[1]) @ (0.2126, 0.7152, 0.0722)) * 10.0


def veil_sum_cd_m2() -> float:
    """The glare function times the light of all pixels, less what is scattered away."""
    view, body, (row, column) = _night()
    left, right, up, down = view.tangents
    width_px, height_px = VEIL_SIZE_PX
    x = left + (np.arange(width_px) + 0.5) / width_px * (right - left)
    y = up + (np.arange(height_px) + 0.5) / height_px * (down - up)
    rays = np.stack([*np.meshgrid(x, y), -np.ones((height_px, width_px))], axis=-1)
    length = np.linalg.norm(rays, axis=-1)
    pixel_sr = (right - left) / width_px * (up - down) / height_px / length**3
    toward = rays / length[..., None]
    angle_deg = np.degrees(np.arccos(np.clip(toward @ toward[row, column], -1.0, 1.0)))
    luminance = view.color.astype(float) @ (0.2126, 0.7152, 0.0722)
    age_years = body["age_years"]
    log_s = 0.87 + math.log10(1.0 + (age_years / 65.0) ** 4)
    per_sr = glare_per_sr(angle_deg, age_years=age_years, log_s=log_s)
    veil = float((per_sr * luminance * pixel_sr).sum())
    angles_deg = np.geomspace(0.01, 90.0, 20_000)
    rings_sr = 2.0 * np.pi * np.sin(np.radians(angles_deg))
    scattered = glare_per_sr(angles_deg, age_years=age_years, log_s=log_s) * rings_sr
    away_ratio = float(np.trapezoid(scattered, np.radians(angles_deg)))
    # The surroundings are assumed to be as bright as the edge of the picture.
    beyond = away_ratio - float((per_sr * pixel_sr).sum())
    edge = [luminance[0], luminance[-1], luminance[:, 0], luminance[:, -1]]
    veil += beyond * float(np.concatenate(edge).mean())
    return 10.0 * (veil - away_ratio * float(luminance[row, column]))
