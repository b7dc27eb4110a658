"""PSFs by the GPU's passes against the float64 quadrature and the CPU's engines."""

import math
import re

import numpy as np
import pytest

from estimator.corrections.kinoform import Kinoform
from estimator.corrections.rings import DiffractiveRings
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import PsfTooLarge, compute_psf_batch
from estimator.psf.fourier import edge_response
from estimator.psf.fourier_kernels import EDGE_HALF_WIDTH
from estimator.psf.kernel_types import disc_mask
from estimator.psf.reference import reference_kernel
from estimator.psf.stiles_crawford import StilesCrawford
from filter_service.constants import WEIGHT_MAX
from filter_service.gl.shader_source import SHADER_ROOT
from filter_service.psfs import (
    gpu_build,
    gpu_build_constants,
    gpu_build_records,
)
from filter_service.psfs.boxes import square_kernel
from filter_service.psfs.gpu_build import gpu_psf_batch
from filter_service.psfs.gpu_build_pace import Pace
from filter_service.psfs.psf_engine import psf_engine
from filter_service.psfs.store import build_psf_store
from tests.grid_specs import grid_spec
from tests.numerical.psf_cases import (
    DENSITIES_MRAD,
    case_zernike_um,
    compared_radius_px,
    configurations,
    field_case,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
    truth,
    zernike_from_terms,
)

PITCH_MRAD = 1.295
MIXED = {"2,-2": 0.4, "2,0": 1.1, "3,-1": -0.5, "3,1": 0.3, "3,3": 0.2, "4,0": 0.15}
COMMON = {"pixel_pitch_mrad": PITCH_MRAD, "wavelength_nm": 550.0}
SHEARED = np.array([[1.4, 0.3], [0.2, 1.1]]) / PITCH_MRAD
ELLIPSE = np.array([0.06, -0.04, 1.35, 1.0, 0.7])
OFF_AXIS = {
    "pupil_diameter_mm": 3.0,
    "wavelength_nm": 550.0,
    "pixel_from_mrad": SHEARED,
    "pupil_ellipse": ELLIPSE,
}


def defocused(vergence_dpt, pupil_mm):
    """Coefficients (P, 28) of pure defocus."""
    zernike_um = np.zeros((np.size(vergence_dpt), 28))
    zernike_um[:, 4] = np.multiply(vergence_dpt, (pupil_mm / 2.0) ** 2)
    return zernike_um / (4.0 * math.sqrt(3.0))


def distances(batch, other):
    """Relative L2 distance of each kernel from the other's."""
    pairs = zip(batch, other, strict=True)
    return np.array(
        [
            np.linalg.norm(a.kernel - b.kernel) / np.linalg.norm(b.kernel)
            for a, b in pairs
        ]
    )


# ----- the parts that need no context


def test_sine_series_is_the_cpus_smoothed_edge():
    depth = np.linspace(-EDGE_HALF_WIDTH, EDGE_HALF_WIDTH, edge_response().size)
    series = 0.5 + depth / (2 * EDGE_HALF_WIDTH)
    for m, b in enumerate(gpu_build_constants.edge_series(), 1):
        series = series + b * np.sin(math.pi * m * depth / EDGE_HALF_WIDTH)
    assert np.abs(series - edge_response()).max() < 5e-4


@pytest.mark.parametrize("length", gpu_build_constants.FFT_RADICES)
def test_work_groups_stay_within_what_core_opengl_promises(length):
    defines = gpu_build_constants.fft_defines(length)
    radices = [defines[f"FFT_RADIX_{i}"] for i in range(3)]
    assert math.prod(radices) == length
    assert defines["FFT_GROUP"] == defines["FFT_LINES"] * defines["FFT_THREADS"]
    assert defines["FFT_GROUP"] <= 256
    # A software renderer works on 8 threads at once.
    assert defines["FFT_GROUP"] % 8 == 0
    assert 16 * defines["FFT_LINES"] * length <= 16384


GLSL_BASE = {"vec4": "f4", "ivec4": "i4"}
"""Of 16 bytes, and aligned to that in std430."""


def shader_members():
    """Members of `PsfRecord` as the shader declares them: name, type, count."""
    text = (SHADER_ROOT / "common/psf_record.glsl").read_text(encoding="utf-8")
    text = re.sub(r"//.*", "", text)
    body = re.search(r"struct PsfRecord \{(.*?)\};", text, re.DOTALL)[1]
    found = []
    for declaration in body.split(";")[:-1]:
        kind, name, count = re.fullmatch(
            r"\s*(\w+) (\w+)(?:\[(\d+)\])?", declaration
        ).groups()
        found.append((name, kind, int(count or 1)))
    return found


def test_records_have_the_layout_of_the_shader():
    """std430: members one behind the other, as the struct of the shader has them."""
    record, offset = gpu_build_records.RECORD, 0
    members = shader_members()
    assert tuple(name for name, _, _ in members) == record.names
    for name, kind, count in members:
        base, shape = record[name].subdtype
        assert (base, np.prod(shape)) == (np.dtype(GLSL_BASE[kind]), 4 * count), name
        assert record.fields[name][1] == offset, name
        offset += 16 * count
    assert record.itemsize == offset


# ----- against the quadrature


WAVE_CASES = [
    ("emmetropia", 3.0, 550.0, "20ppd"),
    ("emmetropia", 5.0, 650.0, "720p50"),
    ("emm_1D", 5.0, 450.0, "35ppd"),
    ("myopia4D", 3.0, 550.0, "720p50"),
    ("astig3D", 2.0, 650.0, "720p50"),
    ("astig3D", 3.0, 550.0, "35ppd"),
    ("keratoconus", 2.0, 550.0, "720p50"),
    ("keratoconus", 3.0, 550.0, "35ppd"),
    ("periph40", 2.0, 550.0, "20ppd"),
    ("periph40", 3.0, 550.0, "720p50"),
]

FIELD_CASES = [
    ("emmetropia", 40, 2.0, "720p50"),
    ("myopia", 20, 3.0, "20ppd"),
    ("astigmatism", 40, 2.0, "720p50"),
    ("keratoconus", 20, 3.0, "35ppd"),
    ("post_lasik", 20, 3.0, "720p50"),
]


@pytest.fixture(scope="module")
def image():
    return make_test_image()


@pytest.fixture(scope="module")
def wave_batch(gpu):
    """All cases in one call: each PSF with a pupil, wavelength and scale of its own."""
    fields = [field_case(*case) for case in FIELD_CASES]
    zernike_um = [case_zernike_um(name, mm) for name, mm, *_ in WAVE_CASES]
    circles = [case[1] for case in WAVE_CASES]
    ellipses = [(0.0, 0.0, mm / 2, mm / 2, 0.0) for mm in circles]
    scales = [np.eye(2) / DENSITIES_MRAD[case[3]] for case in WAVE_CASES]
    wavelengths = [case[2] for case in WAVE_CASES]
    options = {
        "pupil_diameter_mm": circles + [f.options["pupil_diameter_mm"] for f in fields],
        "wavelength_nm": wavelengths + [f.options["wavelength_nm"] for f in fields],
        "pupil_ellipse": ellipses + [f.options["pupil_ellipse"] for f in fields],
        "pixel_from_mrad": scales + [f.options["pixel_from_mrad"] for f in fields],
    }
    zernike_um = np.stack(zernike_um + [f.zernike_um for f in fields])
    options = {name: np.array(values) for name, values in options.items()}
    with gpu.context:
        batch = gpu_psf_batch(gpu, zernike_um, method="fourier", **options)
    return zernike_um, options, batch


@pytest.mark.parametrize("index", range(len(WAVE_CASES) + len(FIELD_CASES)))
def test_wave_method_meets_its_accuracy(index, wave_batch, image, gpu):
    zernike_um, options, batch = wave_batch
    psf = batch[index]
    radius = compared_radius_px(psf.blur_radius_px)
    reference = reference_kernel(
        zernike_um[index],
        radius_px=radius,
        **{name: values[index] for name, values in options.items()},
    )
    kernel, disc = physical_kernel(psf, radius), disc_mask(radius)
    l2, energy = kernel_errors(kernel, reference)
    assert l2 <= (1.5e-2 if "720p50" in (*WAVE_CASES, *FIELD_CASES)[index] else 3e-2)
    assert abs(energy) <= 1e-2
    assert filter_psnr_db(image, kernel * disc, reference * disc) >= 54.0


@pytest.mark.slow
@pytest.mark.parametrize("density", DENSITIES_MRAD)
@pytest.mark.parametrize("case", configurations(), ids=lambda c: "-".join(map(str, c)))
def test_wave_method_meets_its_accuracy_everywhere(case, density, image, gpu):
    name, pupil_mm, wavelength_nm = case
    pitch_mrad = DENSITIES_MRAD[density]
    psf = gpu_psf_batch(
        gpu,
        case_zernike_um(name, pupil_mm)[None],
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch_mrad,
        method="fourier",
    )[0]
    radius = compared_radius_px(psf.blur_radius_px)
    reference = truth(name, pupil_mm, wavelength_nm, pitch_mrad, radius)
    kernel, disc = physical_kernel(psf, radius), disc_mask(radius)
    l2, energy = kernel_errors(kernel, reference)
    assert l2 <= (1.5e-2 if density == "720p50" else 3e-2)
    assert abs(energy) <= 1e-2
    assert filter_psnr_db(image, kernel * disc, reference * disc) >= 54.0


# ----- against the CPU's engines


def test_every_length_of_the_fft_equals_the_cpu(gpu):
    """Defocus until every length has had its turn; spots up to 900 lambda/D wide."""
    vergence_dpt = [0.0, 0.5, 1.0, 2.0, 4.0, 5.5, 9.0, 13.0, 20.0, 28.0]
    zernike_um = defocused(vergence_dpt, 4.0)
    zernike_um[:, 7] = np.linspace(0.0, 0.1, len(zernike_um))
    options = COMMON | {"pupil_diameter_mm": 4.0, "radius_px": 60}
    options |= {"method": "fourier"}
    plan = gpu_build.plan_psfs(zernike_um, **options)
    jobs, on_cpu = gpu_build_records.plan_waves(
        plan,
        np.arange(len(zernike_um)),
        gpu_build_records.kernel_starts(plan),
        accuracy="normal",
        limit_count=1 << 30,
    )
    assert on_cpu.size == 0
    used = {n for chunk in jobs.chunks for n in chunk.lengths}
    assert used == set(gpu_build_constants.FFT_RADICES)
    batch = gpu_psf_batch(gpu, zernike_um, **options)
    expected = compute_psf_batch(zernike_um, accuracy="fine", **options)
    assert distances(batch, expected).max() < 1.5e-2


def test_wavefronts_beyond_the_longest_fft_are_the_cpus(gpu):
    zernike_um = np.concatenate([defocused([60.0], 4.0), defocused([1.0], 4.0)])
    options = COMMON | {"pupil_diameter_mm": 4.0, "method": "fourier"}
    batch = gpu_psf_batch(gpu, zernike_um, **options)
    expected = compute_psf_batch(zernike_um, **options)
    np.testing.assert_allclose(batch[0].kernel, expected[0].kernel, rtol=1e-6)
    assert distances(batch, expected).max() < 1e-2


GEOMETRIES = {
    "plain": {"pupil_diameter_mm": 3.0, **COMMON},
    "sheared ellipse": OFF_AXIS,
    "apodised": OFF_AXIS | {"stiles_crawford": StilesCrawford.of_eye("OD")},
}


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize(("method", "limit"), [("fourier", 1e-2), ("geometric", 1e-3)])
def test_engines_equal_the_cpus(method, limit, geometry, gpu):
    cases = ("emmetropia", "astig3D", "keratoconus", "myopia4D", "periph40")
    zernike_um = np.stack([case_zernike_um(case, 3.0) for case in cases])
    options = GEOMETRIES[geometry] | {"method": method}
    batch = gpu_psf_batch(gpu, zernike_um, **options)
    expected = compute_psf_batch(zernike_um, accuracy="fine", **options)
    assert distances(batch, expected).max() < limit
    np.testing.assert_array_equal(batch.radius_px, expected.radius_px)
    np.testing.assert_allclose(
        batch.lost_energy_ratio, expected.lost_energy_ratio, atol=2e-3
    )


def test_auto_switches_and_fades_as_the_cpu_does(gpu):
    zernike_um = defocused(np.linspace(0.3, 1.0, 51), 5.0)
    options = COMMON | {"pupil_diameter_mm": 5.0}
    batch = gpu_psf_batch(gpu, zernike_um, **options)
    expected = compute_psf_batch(zernike_um, **options)
    words = {psf.method for psf in batch}
    assert words == {"fourier", "geometric", "fourier+geometric"}
    np.testing.assert_array_equal(batch.geometric_ratio, expected.geometric_ratio)
    assert distances(batch, expected).max() < 1e-2


# ----- what must hold for every input


@pytest.mark.parametrize("method", ["fourier", "geometric", "auto"])
def test_kernels_are_finite_with_unit_sum_inside_the_disc(method, gpu):
    terms = ({}, MIXED, {"2,0": 1e-9}, {"4,0": 0.3}, {"1,1": 3.0}, {"6,-6": 0.4})
    zernike_um = np.stack([zernike_from_terms(t) for t in terms])
    batch = gpu_psf_batch(
        gpu, zernike_um, pupil_diameter_mm=4.0, method=method, **COMMON
    )
    for psf in batch:
        assert np.isfinite(psf.kernel).all()
        assert psf.kernel.min() >= 0.0 or method != "geometric"
        assert abs(psf.kernel.sum(dtype=np.float64) - 1.0) < 2e-6
        assert not psf.kernel[~disc_mask(psf.radius_px)].any()
        assert 0.0 <= psf.lost_energy_ratio <= 1e-3


@pytest.mark.parametrize("method", ["fourier", "geometric"])
def test_defocus_through_zero_changes_kernels_smoothly(method, gpu):
    zernike_um = defocused(np.linspace(-0.02, 0.02, 9), 3.0)
    options = COMMON | {"pupil_diameter_mm": 3.0, "method": method, "radius_px": 12}
    batch = gpu_psf_batch(gpu, zernike_um, **options)
    kernels = batch.flat_kernels.reshape(9, -1)
    steps = np.linalg.norm(np.diff(kernels, axis=0), axis=1)
    assert steps.max() < 3e-2 * np.linalg.norm(kernels[4])
    mirrored = np.abs(kernels - kernels[::-1]).max()
    assert mirrored < 1e-4 * kernels.max()


def test_rays_of_a_perfect_eye_meet_in_one_pixel(gpu):
    psf = gpu_psf_batch(
        gpu, np.zeros((1, 28)), pupil_diameter_mm=4.0, diffraction=False, **COMMON
    )[0]
    assert psf.radius_px == 0
    np.testing.assert_allclose(psf.kernel, [[1.0]], rtol=1e-6)


def test_positive_tilt_moves_light_to_the_right_and_up(gpu):
    for terms, (column, row) in (({"1,1": 3.0}, (1, 0)), ({"1,-1": 3.0}, (0, -1))):
        zernike_um = zernike_from_terms(terms)[None]
        for method in ("fourier", "geometric"):
            kernel = gpu_psf_batch(
                gpu, zernike_um, pupil_diameter_mm=4.0, method=method, **COMMON
            )[0].kernel
            middle = kernel.shape[0] // 2
            peak = np.array(np.unravel_index(kernel.argmax(), kernel.shape)) - middle
            # grad W = 2 Z / r = 3 mrad.
            np.testing.assert_array_equal(
                peak, np.rint(3.0 / PITCH_MRAD) * np.array([row, column])
            )


# ----- batches


def _small_limits(monkeypatch):
    monkeypatch.setattr(gpu_build, "BLOCK_PSFS", 5)
    monkeypatch.setattr(gpu_build, "KERNEL_BYTES", 40_000)
    monkeypatch.setattr(gpu_build, "SOFTWARE_SCRATCH_BYTES", 150_000)
    monkeypatch.setattr(gpu_build, "SCRATCH_BYTES", 150_000)


def _mixed_batch():
    zernike_um = defocused(np.linspace(0.0, 6.0, 13), 5.0)
    zernike_um[:, 7] = np.linspace(0.3, 0.0, 13)
    wavelength_nm = np.tile([612.0, 549.0, 464.0], 5)[:13]
    return zernike_um, {
        "pupil_diameter_mm": 5.0,
        "wavelength_nm": wavelength_nm,
        "pixel_pitch_mrad": PITCH_MRAD,
    }


def test_results_do_not_depend_on_how_a_call_is_cut(gpu, monkeypatch):
    zernike_um, options = _mixed_batch()
    whole = gpu_psf_batch(gpu, zernike_um, **options)
    _small_limits(monkeypatch)
    cut = gpu_psf_batch(gpu, zernike_um, workers=2, **options)
    np.testing.assert_array_equal(cut.offset_count, whole.offset_count)
    np.testing.assert_allclose(cut.flat_kernels, whole.flat_kernels, atol=1e-9)
    np.testing.assert_allclose(cut.lost_energy_ratio, whole.lost_energy_ratio)


@pytest.mark.parametrize("hold_s", [1e-9, 0.002])
def test_results_do_not_depend_on_the_pace(gpu, hold_s):
    """At the shorter every PSF waits for the one before it."""
    zernike_um, options = _mixed_batch()
    whole = gpu_psf_batch(gpu, zernike_um, pace=Pace(1e9), **options)
    pace = Pace(hold_s)
    for _ in range(2):
        paced = gpu_psf_batch(gpu, zernike_um, pace=pace, **options)
        np.testing.assert_allclose(paced.flat_kernels, whole.flat_kernels, atol=1e-9)
        np.testing.assert_allclose(paced.lost_energy_ratio, whole.lost_energy_ratio)
    assert hold_s > 1e-6 or pace.n_batches >= 2 * len(zernike_um)


def test_refusals_name_the_psf_of_the_call(gpu, monkeypatch):
    zernike_um, options = _mixed_batch()
    _small_limits(monkeypatch)
    with pytest.raises(PsfTooLarge, match="PSF 9 needs") as error:
        gpu_psf_batch(gpu, zernike_um, max_radius_px=8, **options)
    assert error.value.index == 9
    zernike_um[7, 1] = 60.0
    with pytest.raises(ValueError, match="PSF 7 has no light within 6 px"):
        gpu_psf_batch(gpu, zernike_um, radius_px=6, diffraction=False, **options)


def test_no_wavefronts_give_no_kernels(gpu):
    batch = gpu_psf_batch(gpu, np.zeros((0, 28)), pupil_diameter_mm=3.0, **COMMON)
    assert len(batch) == 0
    assert batch.flat_kernels.size == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "enz"}, "method 'enz'"),
        ({"accuracy": "best"}, "accuracy 'best'"),
        ({"zernike_um": np.zeros((2, 27))}, "zernike_um has shape"),
        ({"pupil_diameter_mm": [1.0, 2.0, 3.0]}, "pupil_diameter_mm has shape"),
        ({"method": "fourier", "diffraction": False}, "includes diffraction"),
    ],
)
def test_wrong_arguments_are_refused(change, message, gpu):
    options = {"zernike_um": np.zeros((2, 28)), "pupil_diameter_mm": 3.0, **COMMON}
    options |= change
    with pytest.raises(ValueError, match=message):
        gpu_psf_batch(gpu, options.pop("zernike_um"), **options)


@pytest.mark.gpu
def test_a_hardware_gpu_computes_what_the_cpu_does(gpu):
    rng = np.random.default_rng(3)
    zernike_um = defocused(rng.uniform(-3.0, 6.0, 4000), 4.0)
    zernike_um[:, 3:15] += rng.normal(0.0, 0.3, (4000, 12))
    options = COMMON | {"pupil_diameter_mm": 4.0}
    for method in ("fourier", "auto"):
        batch = gpu_psf_batch(gpu, zernike_um, method=method, **options)
        expected = compute_psf_batch(zernike_um, method=method, **options)
        assert distances(batch, expected).max() < 3e-2


@pytest.mark.parametrize("stiles_crawford", [False, True])
def test_a_store_is_the_same_from_either_engine(stiles_crawford):
    spec = grid_spec(
        width_px=160,
        height_px=120,
        tangents=(-0.3, 0.3, 0.2, -0.2),
        pupil_range_mm=(4.0, 4.0),
        focus_range_dpt=(0.0, 0.0),
        object_range_dpt=(0.0, 1.0),
        mode="dynamic",
        tolerance="loose",
        stiles_crawford=stiles_crawford,
    )
    profile = parse_profile({"kind": "preset", "name": "astigmatism"})
    stores = [
        build_psf_store(profile, spec, engine=psf_engine(name))
        for name in ("cpu", "gpu")
    ]
    cpu, gpu = (
        [
            square_kernel(s.kernels, int(s.offsets[p]), s.reach_px[p], 60)
            * s.peak_ratio[p]
            / WEIGHT_MAX
            for p in range(0, s.psf_count, 7)
        ]
        for s in stores
    )
    assert stores[0].psf_count == stores[1].psf_count > 20
    errors = [
        np.linalg.norm(a - b) / np.linalg.norm(a) for a, b in zip(cpu, gpu, strict=True)
    ]
    assert max(errors) <= 0.02


def test_pupils_with_rings_are_left_to_the_processor(gpu):
    rings = DiffractiveRings(2.2, Kinoform.sawtooth(0.5))
    options = {
        "pupil_diameter_mm": 3.0,
        "wavelength_nm": 550.0,
        "pixel_pitch_mrad": 1.0,
        "pupil_screen": rings,
    }
    found = gpu_psf_batch(gpu, np.zeros((2, 28)), **options)
    expected = compute_psf_batch(np.zeros((2, 28)), **options)
    assert np.array_equal(found.flat_kernels, expected.flat_kernels)
