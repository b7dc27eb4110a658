"""The tracer in C: twin, number of terms, variants, threads, and numbers it shares."""

import re
from dataclasses import replace

import numpy as np
import pytest

from estimator.eye.assembly import pack_eyes
from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import eye_indices
from estimator.native import core
from estimator.native.library import Core
from estimator.optics import raytrace
from estimator.optics import surfaces as columns
from estimator.optics.forms import (
    FORMS,
    EvenAsphere,
    SeparateProfiles,
    Toroid,
    TwoConics,
)
from estimator.optics.gradients import GRADIENTS, INDEX_FUNCTIONS
from estimator.optics.raytrace import RayStatus, trace_packed, trace_rays
from estimator.optics.surfaces import media_indices, pack_eye
from estimator.optics.zernike import HIGHEST_ORDER, MAX_TERMS, zernike_values
from estimator.wavefront import compiled
from estimator.wavefront.nodes import circle_nodes, stop_nodes
from tests.numerical.schematic_eyes import (
    field_axes,
    irregular_eye,
    navarro,
    reference,
)
from tests.reference.traced_rays import trace
from tests.source_tree import ROOT

SOURCE = ROOT / "estimator" / "native" / "source"

SHAPES = [
    None,
    EvenAsphere((1e-3, -2e-4, 1e-5)),
    TwoConics((-0.5, 0.3)),
    Toroid(),
    SeparateProfiles((-0.4, 0.2)),
]


def formed_eye(form):
    """Offset terms on a turned cornea, and a tilted lens, both of a form."""
    eye = irregular_eye()
    cornea, posterior, lens, back = eye.surfaces
    formed = replace(cornea, form=form), posterior, lens, replace(back, form=form)
    return replace(eye, surfaces=formed)


@pytest.mark.parametrize("form", SHAPES, ids=lambda form: type(form).__name__)
def test_rays_are_those_of_the_twin(form, rng):
    eye = formed_eye(form)
    slopes, heights = rng.uniform(-0.3, 0.3, (5, 2)), rng.uniform(-1.3, 1.3, (5, 2))
    direction = np.column_stack([slopes, np.ones(5)])
    start = np.column_stack([heights - 9.0 * slopes, np.full(5, -6.0)])
    traced = trace_rays(eye, start_mm=start, direction=direction, wavelength_nm=480.0)
    assert np.all(traced.status_index == RayStatus.TRACED)
    elements = np.delete(np.arange(6), traced.stop_index)
    for k in range(5):
        points, paths, _ = trace(eye, start[k], direction[k], 480.0)
        assert np.abs(traced.points_mm[k, elements] - points).max() < 1e-12
        assert np.abs(traced.path_mm[k, elements] - paths).max() < 1e-12


def one_field(eye, *, h_deg=0.0, wavelength_nm=555.0):
    return compiled.Fields.of_grid(
        pack_eye(eye)[None],
        media_indices(eye, [wavelength_nm])[None],
        np.radians([[h_deg, 0.0]]),
    )


@pytest.mark.parametrize("by_slopes", [False, True])
@pytest.mark.parametrize(("n_terms", "error_um"), [(28, 3e-3), (66, 3e-6)])
def test_fits_of_any_number_of_terms_are_the_wavefront(
    n_terms, error_um, by_slopes, rng
):
    """W of other rays than those of the fit, from their optical paths."""
    eye, h_deg = irregular_eye(), 15.0
    (row,) = compiled.stop_rows(
        one_field(eye, h_deg=h_deg),
        stop_radii_mm=np.array([[2.0]]),
        pupil_z_mm=np.nan,
        nodes=stop_nodes(10, 26),
        at_pupil=False,
        by_slopes=by_slopes,
        n_terms=n_terms,
    )[0]
    zernike_um, other = row[:n_terms], row[n_terms:]
    retina, plane = (
        other[at : at + 3] for at in (compiled.RETINA_POINT, compiled.PLANE_POINT)
    )
    to_stop = np.array([0.0, 0.0, eye.stop_z_mm]) - retina
    directions = to_stop + np.pad(rng.uniform(-1.3, 1.3, (40, 2)), ((0, 0), (0, 1)))
    rays = trace_rays(
        eye, start_mm=retina, direction=directions, wavelength_nm=555.0, reverse=True
    )
    ex, ey, u = field_axes(h_deg, 0.0)
    offset = plane - rays.points_mm[:, 0]
    along = (offset @ u) / (rays.direction_ratio[:, 0] @ u)
    at = rays.points_mm[:, 0] + along[:, None] * rays.direction_ratio[:, 0] - plane
    wave_um = -1e3 * (rays.path_mm[:, 0] + along)
    radius_mm = other[compiled.RADIUS]
    fitted = zernike_values(at @ ex / radius_mm, at @ ey / radius_mm, n_terms=n_terms)
    difference_um = wave_um - fitted @ zernike_um
    assert np.ptp(wave_um) > 3.0
    assert np.ptp(difference_um) < error_um


def random_fields(rng, count=30):
    packed = pack_eyes(random_vectors(count, rng))
    directions = np.radians(rng.uniform(-45.0, 45.0, (count, 2)))
    return compiled.Fields.of_eyes(packed, eye_indices(530.0), directions)


def traced(fields, **options):
    """Result rows of stops, coefficients on circles, shifts and magnifications."""
    options = {"pupil_z_mm": 3.0, **options}
    stops_mm = np.repeat([[1.1, 2.4]], len(fields.eyes), axis=0)
    return [
        compiled.stop_rows(
            fields,
            stop_radii_mm=stops_mm,
            nodes=stop_nodes(5, 14),
            at_pupil=True,
            by_slopes=False,
            **options,
        ),
        *compiled.circle_zernike(fields, radii_mm=2.0, nodes=circle_nodes(), **options),
        compiled.chief_shifts(fields, fields.rows),
        compiled.magnifications(fields.packed, fields.indices[0]),
    ]


def test_results_do_not_depend_on_threads(rng):
    fields = random_fields(rng)
    for one, many in zip(
        traced(fields, n_threads=1), traced(fields, n_threads=3), strict=True
    ):
        np.testing.assert_array_equal(one, many)


def test_both_variants_trace_alike(rng, monkeypatch):
    fields, n_terms = random_fields(rng), 28
    found = traced(fields)
    portable = Core(core().path, portable=True)
    monkeypatch.setattr(compiled, "core", lambda: portable)
    again = traced(fields)
    is_open = found[0][..., n_terms + compiled.OPEN_SHARE] > 1.0 - 1e-12
    assert is_open.sum() > 40
    shape = slice(n_terms + compiled.ELLIPSE + 3)  # without the axis of a circle
    error = np.abs(found[0] - again[0])[is_open][:, shape]
    assert error.max() < 1e-7
    np.testing.assert_array_equal(found[2], again[2])
    for k in (1, 3, 4):
        np.testing.assert_allclose(found[k], again[k], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("stop_mm", [1.7, 2.0, 3.0])
def test_a_clear_radius_leaves_the_light_within_it(stop_mm):
    """Rays are found up to the edge, however far beyond it the stop is open."""
    eye = navarro(reference())
    lens = replace(eye.surfaces[2], clear_radius_mm=1.6)
    eye = replace(eye, surfaces=(*eye.surfaces[:2], lens, eye.surfaces[3]))
    found = compiled.stop_rows(
        one_field(eye),
        stop_radii_mm=np.array([[1.5, stop_mm]]),
        pupil_z_mm=np.nan,
        nodes=stop_nodes(5, 14),
        at_pupil=False,
        by_slopes=False,
    )[0, :, 28 + compiled.OPEN_SHARE]
    assert found[0] == pytest.approx(1.0)
    # rays converge by 1 % of their distance from the axis behind the stop
    assert found[1] == pytest.approx((1.6 / stop_mm) ** 2, rel=0.03)


def test_vignetted_pupils_are_left_if_only_whole_ones_are_wanted():
    eye = navarro(reference())
    lens = replace(eye.surfaces[2], clear_radius_mm=1.6)
    clipped = replace(eye, surfaces=(*eye.surfaces[:2], lens, eye.surfaces[3]))
    some, whole = (
        compiled.stop_rows(
            one_field(clipped),
            stop_radii_mm=np.array([[1.5, 2.0, 1.2]]),
            pupil_z_mm=np.nan,
            nodes=stop_nodes(5, 14),
            at_pupil=False,
            by_slopes=False,
            only_whole=only_whole,
        )[0]
        for only_whole in (False, True)
    )
    np.testing.assert_array_equal(some[[0, 2]], whole[[0, 2]])
    assert np.isnan(whole[1, :28]).all()
    assert whole[1, 28 + compiled.OPEN_SHARE] == 0.0
    status = 28 + compiled.WORST_STATUS
    assert whole[1, status] == some[1, status] == RayStatus.CLIPPED


def test_unknown_forms_and_gradients_are_missed():
    """A packed eye of another version never calls beyond the tables."""
    packed, rays = pack_eye(irregular_eye()), np.array([[0.0, 0, -9, 0, 0, 1]])
    indices = media_indices(irregular_eye(), 555.0)
    packed[0, columns.FORM] = columns.FIRST_FORM + len(FORMS)
    assert trace_packed(packed, indices, rays).status_index == RayStatus.MISSED
    packed = pack_eye(irregular_eye())
    packed[2, columns.GRADIENT] = len(indices)
    packed[2:4, columns.NEAR_GRADIENT] = 1.0
    medium = [len(INDEX_FUNCTIONS), 4.0, 1.0, 1.0, 1.4]
    found = trace_packed(packed, np.append(indices, medium), rays)
    assert found.status_index != RayStatus.TRACED


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"eyes": np.array([1])}, "eye 1: there are 1"),
        ({"rows": np.array([-1])}, "index row -1: there are 1"),
        ({"packed": np.zeros((1, 5, 60))}, "60 columns .* must be 64"),
        ({"directions_rad": np.zeros((2, 2))}, "broadcast"),
    ],
)
def test_fields_outside_their_arrays_are_refused(changes, reason):
    fields = replace(one_field(irregular_eye()), **changes)
    with pytest.raises(ValueError, match=reason):
        compiled.chief_shifts(fields, 0)


def enumerated(file):
    """Constants of the enumerations in a header, by name."""
    text = (SOURCE / file).read_text(encoding="utf-8")
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.S)
    found = {"N_LANES": 4}
    for body in re.findall(r"\benum \{([^}]*)\}", text):
        for name, value in re.findall(r"(\w+) = ([^,}]+)", body):
            found[name] = eval(value, {}, found) if "sizeof" not in value else None
    return found


def test_columns_and_outcomes_are_those_of_the_source():
    packed = enumerated("packed_eye.h") | enumerated("forms.h")
    names = [name for name in vars(columns) if name.isupper() and name in packed]
    assert len(names) > 20
    for name in names:
        assert packed[name] == getattr(columns, name), name
    assert [packed[status.name] for status in RayStatus] == list(RayStatus)
    assert packed["IDLE"] not in list(raytrace.RayStatus)
    results = enumerated("pupil_fit.h")
    text = (SOURCE / "wavefronts.h").read_text(encoding="utf-8")
    body = text[text.index("    RADIUS = 0") : text.index("    N_OTHER_RESULTS")]
    for line in re.sub(r"/\*.*?\*/", "", body).split(",")[:-1]:
        name, value = line.strip().split(" = ")
        results[name] = eval(value, {}, results)
        assert results[name] == getattr(compiled, name), name
    assert results["PLANE_POINT"] + 3 == compiled.N_OTHER


def test_largest_numbers_of_terms_are_those_of_python():
    text = (SOURCE / "terms.h").read_text(encoding="utf-8")
    defined = dict(re.findall(r"#define (\w+) (\d+)", text))
    assert int(defined["MOST_TERMS"]) == MAX_TERMS
    assert int(defined["MOST_ORDER"]) == HIGHEST_ORDER


def test_tables_of_the_source_have_the_order_of_python():
    text = (SOURCE / "forms.h").read_text(encoding="utf-8")
    sags = re.findall(r"^    (\w+)_sag,", text, re.MULTILINE)
    assert sags[columns.FIRST_FORM :] == [form.kind for form in FORMS]
    text = (SOURCE / "gradients.h").read_text(encoding="utf-8")
    (row,) = re.findall(r"INDEX_FUNCTIONS\[\] = \{(.*?)\}", text, re.S)
    assert re.findall(r"(\w+)_index", row) == list(INDEX_FUNCTIONS)
    assert {gradient.index for gradient in GRADIENTS} == set(INDEX_FUNCTIONS)
