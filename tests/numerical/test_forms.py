"""Forms of surfaces against optiland, an independent tracer, and each other."""

import json
from dataclasses import replace

import numpy as np
import pytest

from estimator.optics.forms import EvenAsphere, TwoConics
from estimator.optics.paraxial import cardinal_points
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.wavefront.aberrations import wavefront_aberrations
from tests.numerical.optiland_eye import (
    FROZEN_FORMS,
    WAVELENGTH_NM,
    formed_eyes,
    random_rays,
    trace_with_optiland,
)
from tests.numerical.schematic_eyes import irregular_eye, navarro, reference
from tests.numerical.surface_bodies import parsed_eye
from tests.reference.traced_rays import trace

TRACED = json.loads(FROZEN_FORMS.read_text(encoding="utf-8"))["eyes"]
TOLERANCE_MM = 1e-12


def _compare(body, rays, points, directions, paths):
    # optiland's Newton iteration returns nan for some rays at its smallest tolerance
    complete = np.isfinite(points).all(axis=(1, 2))
    assert complete.sum() > 0.6 * len(rays)
    traced = trace_rays(
        parsed_eye(body),
        start_mm=rays[complete, :3],
        direction=rays[complete, 3:],
        wavelength_nm=WAVELENGTH_NM,
    )
    assert np.all(traced.status_index == RayStatus.TRACED)
    assert np.abs(traced.points_mm - points[complete]).max() < TOLERANCE_MM
    assert np.abs(traced.direction_ratio - directions[complete]).max() < 1e-13
    assert np.abs(traced.path_mm - paths[complete]).max() < TOLERANCE_MM


@pytest.mark.parametrize("name", TRACED)
def test_optiland_traced_the_form_alike(name):
    data = TRACED[name]
    keys = ("rays", "points_mm", "directions", "paths_mm")
    _compare(data["eye"], *(np.array(data[key]) for key in keys))


@pytest.mark.filterwarnings("ignore")  # optiland's own
def test_optiland_traces_new_eyes_of_every_form_alike(rng):
    pytest.importorskip("optiland", reason="extra `crosscheck` is not installed")
    for body in formed_eyes(rng).values():
        rays = random_rays(rng)
        _compare(body, rays, *trace_with_optiland(body, rays))


def _with_cornea(**changes):
    eye = navarro(reference())
    return replace(
        eye, surfaces=(replace(eye.surfaces[0], **changes), *eye.surfaces[1:])
    )


def test_an_ellipsoid_with_three_axes_obeys_snell(rng):
    """The form whose meridians have conics of their own, which optiland lacks."""
    eye = _with_cornea(
        radius_mm=(7.6, 8.0),
        rotation_deg=20.0,
        tilt_deg=(3.0, -4.0),
        form=TwoConics((-0.5, 0.3)),
    )
    for ray in random_rays(rng, 12):
        traced = trace_rays(
            eye, start_mm=ray[:3], direction=ray[3:], wavelength_nm=WAVELENGTH_NM
        )
        points, paths, _ = trace(eye, ray[:3], ray[3:], WAVELENGTH_NM)
        elements = [e for e in range(6) if e != traced.stop_index]
        assert np.abs(traced.points_mm[0, elements] - points).max() < 1e-12
        assert np.abs(traced.path_mm[0, elements] - paths).max() < 1e-12


@pytest.mark.parametrize("form", [EvenAsphere(()), TwoConics((-0.26, -0.26))])
def test_a_form_without_its_terms_is_the_conic(form):
    plain, formed = navarro(reference()), _with_cornea(form=form)
    arguments = {"wavelength_nm": 555.0, "stop_diameter_mm": 4.0, "h_deg": 30.0}
    found = [wavefront_aberrations(e, **arguments).zernike_um for e in (plain, formed)]
    assert np.abs(found[0] - found[1]).max() < 1e-10


def test_offset_terms_add_to_a_form(rng):
    """An asphere's r⁴ is an offset term's: 6 r⁴ - 6 r² + 1 on the circle of j = 12."""
    amount, radius = 0.02, 6.2
    offset = np.zeros(28)
    offset[12] = amount
    scaled = (-6.0 * amount / radius**2, 6.0 * amount / radius**4)
    eye = irregular_eye()
    cornea = replace(eye.surfaces[0], offset_mm=None, rotation_deg=0.0)
    variants = (
        replace(cornea, offset_mm=offset, form=EvenAsphere((1e-3,))),
        replace(cornea, form=EvenAsphere((1e-3 + scaled[0], scaled[1]))),
    )
    rays = random_rays(rng, 20)
    traced = [
        trace_rays(
            replace(
                eye,
                surfaces=(
                    replace(v, z_mm=amount if v.offset_mm is None else 0.0),
                    *eye.surfaces[1:],
                ),
            ),
            start_mm=rays[:, :3],
            direction=rays[:, 3:],
            wavelength_nm=555.0,
        )
        for v in variants
    ]
    assert np.abs(traced[0].points_mm - traced[1].points_mm).max() < 1e-11


def test_the_squared_term_of_an_asphere_has_power():
    """a2 r² has the curvature 2 a2, as a paraboloid of radius 1 / (2 a2)."""
    by_radius = _with_cornea(radius_mm=(7.0, 7.0))
    added = 0.5 * (1.0 / 7.0 - 1.0 / 7.72)
    by_term = _with_cornea(form=EvenAsphere((added,)))
    powers = [
        cardinal_points(eye, wavelength_nm=555.0).power_dpt
        for eye in (by_radius, by_term)
    ]
    assert powers[0] == pytest.approx(powers[1], abs=1e-10)


BODY = {
    "surfaces": [
        {"radius_mm": 7.8, "z_mm": 0, "medium_after": "aqueous"},
        {"radius_mm": 10, "z_mm": 3.6, "medium_after": "lens"},
        {"radius_mm": -6, "z_mm": 7.6, "medium_after": "vitreous"},
    ],
    "stop_z_mm": 3.6,
    "retina": {"radius_mm": 12, "z_mm": 24},
}


def _surfaces(index, **changes):
    surfaces = list(BODY["surfaces"])
    surfaces[index] = {**surfaces[index], **changes}
    return {**BODY, "surfaces": surfaces}


@pytest.mark.parametrize(
    ("body", "message"),
    [
        # the rear of the lens at the front's pole, curved the other way
        (_surfaces(2, z_mm=3.62), r"surfaces\[2\] crosses surfaces\[1\]"),
        (_surfaces(2, z_mm=3.0), r"surfaces\[2\].z_mm 3: must not lie in front"),
        ({**BODY, "indices": {"lens": -1.4}}, r"indices.lens"),
        (
            {**BODY, "media": {"lens": {"kind": "constant", "index": 0.5}}},
            r"surfaces\[1\].*index 0.5",
        ),
        ({**BODY, "surfaces": [*BODY["surfaces"]] * 400}, "1 to 20 surfaces"),
        ({**BODY, "retina": {"radius_mm": 12, "z_mm": 5}}, "retina at 5 mm"),
        (_surfaces(0, form={"kind": "even"}), r"surfaces\.0\.form.kind"),
        (_surfaces(0, form={"kind": "even_asphere"}), "coefficients.*is missing"),
        (
            _surfaces(0, form={"kind": "even_asphere", "coefficients": [0.1] * 13}),
            r"surfaces\.0\.form.*1 to 12",
        ),
        (
            _surfaces(0, form={"kind": "two_conics", "conic_constants": [1]}),
            r"conic_constants.*has 1 elements",
        ),
        (
            _surfaces(0, form={"kind": "toroid", "color": 1}),
            r"surfaces\.0\.form.color",
        ),
        (
            {**BODY, "media": {"lens": {"kind": "abbe_number", "d_line_index": 1.5}}},
            r"media.lens.abbe_number.*is missing",
        ),
        (
            {**BODY, "media": {"lens": {"kind": "cauchy", "coefficients": ["a"]}}},
            r"media.lens.coefficients\.0",
        ),
    ],
)
def test_a_malformed_eye_is_refused_with_the_surface_and_the_reason(body, message):
    with pytest.raises(ValueError, match=message):
        parsed_eye(body)


def test_an_eye_in_json_keeps_its_forms_and_media():
    body = _surfaces(
        1, form={"kind": "even_asphere", "coefficients": [0, 1e-4]}, medium_after="grin"
    )
    gradient = {
        "kind": "polynomial_gradient",
        "coefficients": [[1.38, 0.04], [-0.002]],
        "dispersion": {"kind": "cauchy", "coefficients": [1.4, 0.006]},
        "steps": 6,
    }
    retina = {
        **BODY["retina"],
        "form": {"kind": "two_conics", "conic_constants": [1, 2]},
    }
    eye = parsed_eye({**body, "media": {"grin": gradient}, "retina": retina})
    assert eye.surfaces[1].form == EvenAsphere((0.0, 1e-4))
    assert eye.retina.form == TwoConics((1.0, 2.0))
    grin = eye.media["grin"]
    assert grin.coefficients == ((1.38, 0.04), (-0.002,))
    assert grin.steps == 6
    assert grin.vertex_index(555.0) == 1.38
    assert grin.vertex_index(450.0) > 1.38
