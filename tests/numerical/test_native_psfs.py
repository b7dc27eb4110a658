"""The compiled PSF engine: against the Python one, the quadrature, and itself."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimator.corrections.rings import (
    DiffractiveRings,
    Kinoform,
    Lenslets,
    RefractiveZones,
)
from estimator.native import Core, core
from estimator.optics.zernike import padded_terms, zernike_gradient
from estimator.psf.compiled import CompiledPsfs
from estimator.psf.compute import compute_psf_batch
from estimator.psf.kernel_types import PsfTooLarge
from estimator.psf.stiles_crawford import StilesCrawford
from filter_service.planning.node_wavefronts import NodeWavefronts
from filter_service.psfs.compute_kernels import mean_batch
from filter_service.psfs.native_psfs import (
    NativePsfs,
    NodeRings,
    native_psfs,
)
from filter_service.psfs.pack import pack_kernels
from tests.numerical.psf_cases import CASE_NAMES, case_zernike_um
from tests.reference.packed_kernels import square_kernel
from tests.reference.psf_integral import reference_kernel

RGB_NM = np.array([[610.0], [536.0], [460.0]])
KEPT = 0.99
LENSES = {
    "diffractive": DiffractiveRings(spacing_dpt=3.0, kinoform=Kinoform.sawtooth(0.5)),
    "zones": RefractiveZones(outer_mm=(1.0, 1.6), powers_dpt=(0.0, 2.0)),
    "lenslets": Lenslets(
        power_dpt=3.5, diameter_mm=1.03, pitch_mm=1.5, inner_mm=0.5, outer_mm=16.0
    ),
}


def wavefronts_of(
    zernike_um,
    *,
    pupil_mm=4.0,
    pitch_mrad=0.73,
    ellipse=None,
    jacobian=None,
    wavelength_nm=RGB_NM,
):
    """Nodes whose three channels have the same wavefront, n groups."""
    zernike_um = np.atleast_2d(zernike_um)
    count, primaries = len(zernike_um), wavelength_nm.shape[1]
    shape = (count, 3, primaries)
    ellipse = (
        (0.0, 0.0, pupil_mm / 2, pupil_mm / 2, 0.0) if ellipse is None else ellipse
    )
    jacobian = np.eye(2) / pitch_mrad if jacobian is None else jacobian
    return NodeWavefronts(
        zernike_um=np.tile(zernike_um[:, None, None], (1, 3, primaries, 1)),
        per_dpt_um=np.zeros((*shape, zernike_um.shape[1])),
        circle_diameter_mm=np.full(shape, pupil_mm),
        pupil_ellipse=np.broadcast_to(ellipse, (*shape, 5)).copy(),
        wavelength_nm=wavelength_nm,
        pixel_from_mrad=np.broadcast_to(jacobian, (count, 2, 2)).copy(),
        h_deg=np.zeros(count),
        v_deg=np.zeros(count),
    )


def asked(wavefronts):
    """Every channel of every group, at 0 dpt."""
    count = 3 * len(wavefronts.h_deg)
    return np.arange(count) // 3, np.arange(count) % 3, np.zeros(count)


def computed(wavefronts, *, engine=None, **options):
    engine = engine or native_psfs()
    options = {"kept_energy_ratio": KEPT, "max_radius_px": 255} | options
    return engine.kernels(wavefronts, *asked(wavefronts), **options)


def twin(wavefronts, *, diffraction=True, stiles_crawford=None, rings=None):
    """The same kernels by `compute_psf_batch` and `pack_kernels`."""
    groups, channels, total_dpt = asked(wavefronts)
    primaries = wavefronts.wavelength_nm.shape[1]
    found = wavefronts.at(groups, channels, total_dpt)
    each = np.repeat(groups, primaries)
    directions_deg = wavefronts.h_deg[each], wavefronts.v_deg[each]
    batch = compute_psf_batch(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        stiles_crawford=stiles_crawford,
        pupil_screen=rings and rings.seen_from(*directions_deg),
        wavelength_nm=wavefronts.wavelength_nm[channels].ravel(),
        pixel_from_mrad=wavefronts.pixel_from_mrad[each],
        diffraction=diffraction,
        min_energy_ratio=1.0 - 0.2 * (1.0 - KEPT),
    )
    return pack_kernels(mean_batch(batch, primaries), kept_energy_ratio=KEPT)


def kernel(packed, k, radius_px=255):
    """Kernel (2R+1, 2R+1) of unit sum; an octagon's corners may lie outside."""
    reach = packed.reach_px[k]
    own = int(max(reach.max(), packed.radius_px[k], radius_px))
    square = square_kernel(packed.weights, int(packed.offsets[k]), reach, own)
    part = slice(own - radius_px, own + radius_px + 1)
    return square[part, part] / square.sum()


def error_ratio(found, truth):
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def shared_error_ratio(found, truth):
    """Relative error of the texels that are nonzero in both kernels."""
    shared = (found > 0.0) & (truth > 0.0)
    return error_ratio(found[shared], truth[shared])


def unshared_light_ratio(first, second):
    """Larger share of the light of a kernel in texels that are zero in the other."""
    return max(first[second <= 0.0].sum(), second[first <= 0.0].sum())


def random_zernike(rng, count, waves):
    """Wavefronts of random size: low orders dominate."""
    zernike_um = rng.standard_normal((count, 28))
    order = np.repeat(np.arange(7), np.arange(1, 8))
    zernike_um *= waves * rng.random((count, 1)) / np.maximum(order - 1, 1) ** 2
    zernike_um[:, 0] = 0.0
    zernike_um[:, 1:3] *= 0.1
    return zernike_um


@settings(max_examples=3, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    waves=st.sampled_from([0.05, 0.5, 2.0, 6.0]),
    pupil_mm=st.sampled_from([1.0, 3.0, 5.0, 8.0]),
    pitch_mrad=st.sampled_from([0.3, 0.73, 2.0, 5.0]),
)
@example(seed=396, waves=6.0, pupil_mm=1.0, pitch_mrad=2.0)
def test_random_wavefronts_have_the_kernels_of_the_python_engine(
    seed, waves, pupil_mm, pitch_mrad
):
    rng = np.random.default_rng(seed)
    minor = rng.uniform(0.6, 0.95)
    ellipse = 0.5 * pupil_mm * np.array([0.02, -0.03, 0.95, minor, 0.0])
    ellipse[4] = rng.uniform(-3.0, 3.0)
    jacobian = np.array([[1.0, rng.uniform(-0.2, 0.2)], [0.1, 1.1]]) / pitch_mrad
    wavefronts = wavefronts_of(
        random_zernike(rng, 4, waves),
        pupil_mm=pupil_mm,
        ellipse=ellipse,
        jacobian=jacobian,
    )
    try:
        theirs = twin(wavefronts)
    except PsfTooLarge:
        *_, left = computed(wavefronts)
        assert left.size
        return
    ours, methods, left = computed(wavefronts)
    assert not left.size
    assert methods.total() == 12
    for k in range(12):
        pair = kernel(ours, k), kernel(theirs, k)
        # One engine may crop a row or column that the other keeps.  In the example,
        # these texels contain 0.2 % of the light, but 5.5 % of the kernel's norm.
        assert shared_error_ratio(*pair) <= 0.02, k
        assert unshared_light_ratio(*pair) <= 0.01, k
        assert ours.spread_px[k] == pytest.approx(theirs.spread_px[k], rel=0.05)
        # what is kept differs by what is meant by the light outside
        assert ours.lost_energy_ratio[k] <= 1.4 * (1.0 - KEPT)


SLOW_CASES = ("emm_1D", "myopia4D")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_CASES))
        for name in CASE_NAMES
    ],
)
def test_cases_are_as_near_the_quadrature_as_the_python_engine(name):
    # small pixels take the quadrature minutes, and 4 mm ten times as long as 2.5 mm
    pupil_mm, pitch_mrad, radius_px = 2.5, 1.5, 18
    zernike_um = case_zernike_um(name, pupil_mm)
    wavefronts = wavefronts_of(zernike_um, pupil_mm=pupil_mm, pitch_mrad=pitch_mrad)
    ours, _, left = computed(wavefronts)
    assert not left.size
    theirs = twin(wavefronts)
    truth = reference_kernel(
        zernike_um,
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=536.0,
        radius_px=radius_px,
        pixel_pitch_mrad=pitch_mrad,
    )
    truth /= truth.sum()
    middle = slice(255 - radius_px, 255 + radius_px + 1)
    error, other = (
        error_ratio(kernel(p, 1)[middle, middle], truth) for p in (ours, theirs)
    )
    assert error <= max(1.1 * other, other + 0.002)
    assert error <= 0.04


@pytest.mark.parametrize("n_terms", [36, 66])
def test_wavefronts_of_higher_order_are_near_the_quadrature(n_terms):
    rng = np.random.default_rng(n_terms)
    zernike_um = padded_terms(random_zernike(rng, 1, 0.3)[0], n_terms).copy()
    zernike_um[28:] = 0.06 * rng.standard_normal(n_terms - 28)
    pupil = {"pupil_mm": 2.0, "pitch_mrad": 1.0}
    ellipse, radius_px = (0.02, -0.03, 0.95, 0.7, 0.6), 9
    ours, methods, left = computed(wavefronts_of(zernike_um, ellipse=ellipse, **pupil))
    assert not left.size
    assert methods["fourier"] == 3
    truth, of_28 = (
        reference_kernel(
            wave_um,
            pupil_diameter_mm=2.0,
            wavelength_nm=536.0,
            radius_px=radius_px,
            pixel_pitch_mrad=1.0,
            pupil_ellipse=ellipse,
        )
        for wave_um in (zernike_um, zernike_um[:28])
    )
    middle = slice(255 - radius_px, 255 + radius_px + 1)
    found = kernel(ours, 1)[middle, middle]
    found = found / found.sum()
    assert error_ratio(found, truth / truth.sum()) <= 0.02
    assert error_ratio(found, of_28 / of_28.sum()) > 0.2


@pytest.mark.parametrize("n_terms", [36, 66])
def test_rays_of_higher_order_land_where_its_slopes_point(n_terms):
    """The moments of a spot are those of the slopes over the pupil."""
    rng = np.random.default_rng(n_terms)
    zernike_um = padded_terms(random_zernike(rng, 1, 6.0)[0], n_terms).copy()
    zernike_um[28:] = 0.1 * rng.standard_normal(n_terms - 28)
    ours, methods, _ = computed(
        wavefronts_of(zernike_um, pupil_mm=6.0, pitch_mrad=0.3),
        diffraction=False,
        kept_energy_ratio=1.0,
    )
    assert methods["geometric"] == 3
    radius, weight = np.polynomial.legendre.leggauss(24)
    angle = 2.0 * np.pi * np.arange(48) / 48
    radius = np.sqrt(0.5 + 0.5 * radius)[:, None]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    slope_px = zernike_gradient(x, y, n_terms=n_terms) @ zernike_um / 3.0 / 0.3
    mean_px = np.einsum("r,rak->k", weight, slope_px) / 96
    spread_px2 = np.einsum("r,rak->k", weight, (slope_px - mean_px) ** 2) / 96
    found, pixels = kernel(ours, 1), np.arange(-255, 256)
    along = found.sum(axis=0), found.sum(axis=1)[::-1]  # x right, y up
    for share, mean, spread in zip(along, mean_px, spread_px2, strict=True):
        own_mean = share @ pixels
        assert own_mean == pytest.approx(mean, abs=0.02)
        own_spread = share @ (pixels - own_mean) ** 2
        # pixels and footprints widen it a little; orders above 6, by 2.8 or more
        assert own_spread == pytest.approx(spread, rel=0.002, abs=0.7)


@pytest.mark.parametrize("waves", [0.3, 6.0])
def test_terms_of_zero_change_no_kernel(waves):
    zernike_um = random_zernike(np.random.default_rng(5), 4, waves)
    ours, *_ = computed(wavefronts_of(zernike_um))
    longer, *_ = computed(wavefronts_of(padded_terms(zernike_um, 66)))
    assert np.array_equal(ours.reach_px, longer.reach_px)
    difference = ours.weights.astype(int) - longer.weights
    assert np.abs(difference).max() <= 1


def test_apodized_pupils_and_wide_primaries_are_those_of_the_python_engine():
    rng = np.random.default_rng(3)
    effect = StilesCrawford(centre_mm=(0.5, 0.2))
    wide_nm = np.array(
        [[590.0, 610.0, 640.0], [510.0, 536.0, 560.0], [440.0, 460.0, 480.0]]
    )
    wavefronts = wavefronts_of(
        random_zernike(rng, 4, 1.5), pupil_mm=6.0, wavelength_nm=wide_nm
    )
    ours, *_ = computed(wavefronts, stiles_crawford=effect)
    theirs = twin(wavefronts, stiles_crawford=effect)
    for k in range(12):
        assert error_ratio(kernel(ours, k), kernel(theirs, k)) <= 0.03, k


def test_without_diffraction_a_perfect_eye_has_one_pixel():
    rng = np.random.default_rng(4)
    zernike_um = np.concatenate([np.zeros((1, 28)), random_zernike(rng, 3, 1.0)])
    wavefronts = wavefronts_of(zernike_um)
    ours, methods, _ = computed(wavefronts, diffraction=False)
    assert methods == {"geometric": 12}
    assert kernel(ours, 0)[255, 255] == pytest.approx(1.0, abs=1e-6)
    theirs = twin(wavefronts, diffraction=False)
    for k in range(3, 12):
        assert error_ratio(kernel(ours, k), kernel(theirs, k)) <= 0.02, k


HARD = {
    "20 dpt": ({4: 5.8}, 2.0, 0.73),
    "pupil of 1 mm": ({4: 0.05}, 1.0, 0.3),
    "pupil of 8 mm": ({4: 1.0, 12: 0.6}, 8.0, 0.73),
    "cylinder of 8 dpt": ({4: 3.0, 5: 4.3}, 3.0, 0.73),
    "cylinder with a meridian in focus": ({4: 1.0, 5: 2.0**0.5}, 4.0, 0.73),
    "coma": ({8: 1.5}, 5.0, 0.73),
    "trefoil": ({6: 1.5}, 5.0, 0.73),
    "pixels of 0.1 mrad": ({4: 0.05}, 3.0, 0.1),
    "pixels of 5 mrad": ({4: 1.0}, 5.0, 5.0),
    "flat": ({}, 4.0, 0.73),
    "highest orders": ({21: 0.3, 27: 0.3, 24: 0.2}, 6.0, 0.73),
}


@pytest.mark.parametrize("name", HARD)
def test_hard_wavefronts(name):
    terms, pupil_mm, pitch_mrad = HARD[name]
    zernike_um = np.zeros(28)
    for index, value in terms.items():
        zernike_um[index] = value
    wavefronts = wavefronts_of(zernike_um, pupil_mm=pupil_mm, pitch_mrad=pitch_mrad)
    ours, _, left = computed(wavefronts)
    assert not left.size
    theirs = twin(wavefronts)
    for k in range(3):
        found = kernel(ours, k)
        assert np.isfinite(found).all()
        assert found.min() >= 0.0
        assert error_ratio(found, kernel(theirs, k)) <= 0.04, k


def test_wavefronts_that_are_not_computed_here_are_named():
    zernike_um = np.zeros((3, 28))
    zernike_um[1, 4] = 500.0  # far beyond 255 px
    zernike_um[2, 4] = np.nan
    packed, methods, left = computed(wavefronts_of(zernike_um))
    assert left.tolist() == [3, 4, 5, 6, 7, 8]
    assert methods.total() == 3
    assert packed.weights.size == (packed.reach_px[:3, :2].sum(1) + 1) @ (
        packed.reach_px[:3, 2:].sum(1) + 1
    )


def test_kernels_do_not_depend_on_the_batch_or_on_threads():
    rng = np.random.default_rng(5)
    zernike_um = random_zernike(rng, 30, 3.0)
    whole, *_ = computed(wavefronts_of(zernike_um))
    library = core()
    alone = NativePsfs(CompiledPsfs(library, library.new_threads(1)))
    backward, *_ = computed(wavefronts_of(zernike_um[::-1]), engine=alone)
    library.end_threads(alone.engine.threads)
    for k in range(90):
        other = 3 * (29 - k // 3) + k % 3
        np.testing.assert_array_equal(whole.reach_px[k], backward.reach_px[other])
        np.testing.assert_array_equal(kernel(whole, k), kernel(backward, other))


def test_processors_without_vectors_have_the_same_kernels():
    library = Core(core().path, portable=True)
    portable = NativePsfs(CompiledPsfs(library, library.new_threads(2)))
    assert library.variant == "portable"
    wavefronts = wavefronts_of(random_zernike(np.random.default_rng(6), 8, 2.0))
    ours, theirs = (computed(wavefronts, engine=e)[0] for e in (None, portable))
    library.end_threads(portable.engine.threads)
    for k in range(24):
        assert error_ratio(kernel(theirs, k), kernel(ours, k)) <= 0.01, k


@pytest.mark.parametrize("lens", LENSES)
def test_pupils_behind_rings_are_those_of_the_python_engine(lens):
    rings = LENSES[lens]
    rng = np.random.default_rng(7)
    wavefronts = wavefronts_of(random_zernike(rng, 3, 0.8), pupil_mm=4.5)
    tables = NodeRings.of(rings, wavefronts, wavefronts)
    ours, methods, left = computed(wavefronts, rings=tables)
    assert not left.size
    assert methods == {"fourier": 9}
    theirs = twin(wavefronts, rings=rings)
    for k in range(9):
        assert error_ratio(kernel(ours, k), kernel(theirs, k)) <= 0.03, k
    without, *_ = computed(wavefronts)
    assert error_ratio(kernel(ours, 1), kernel(without, 1)) > 0.1
