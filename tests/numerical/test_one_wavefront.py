"""One wavefront of an eye by every way to it, in ten directions.

| way | directions | coefficients |
|---|---|---|
| `prepare_eye` with `nodes_deg` | exact | in the entrance pupil |
| `field_table`, the command `field` | exact up to 100 | in the pupil, at the cornea |
| the command `psf` | exact | in the pupil |
| the command `wavefront` | exact | at the cornea |
| `prepare_eye` by default | interpolated | in the pupil |
| `EyeFilter`: the nodes of its PSFs | interpolated | in the pupil |

The command `wavefront` traces an eye that is given by its surfaces to where the chief
ray meets the cornea, 3.7 mm from the entrance pupil at 44 deg.  Otherwise, the plane at
the cornea is at the distance on the axis, 3 mm, in every direction.
"""

import json

import numpy as np
import pytest

from clients.commands.psf import _state
from estimator.estimate.model import eye_model
from estimator.field.field_table import field_table
from estimator.field.prepare import prepare_eye
from estimator.optics.units import MRAD_PER_RAD
from estimator.optics.zernike import N_TERMS, rescale_pupil
from estimator.profiles.files import load_profile
from estimator.profiles.parse import preset_names
from estimator.psf.compute import compute_psfs
from estimator.wavefront.aberrations import wavefront_grid
from filter_service.camera import Camera
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.planning.grid import GREEN
from tests.commands import run_command

CAMERA = Camera.from_fov(60, width_px=320, height_px=180)
H_DEG, V_DEG = (-40.0, -20.0, 0.0, 15.0, 35.0), (-18.0, 5.0)
"""Ten directions; of `EyeFilter`, the nodes next to them."""

PIXEL_MRAD = MRAD_PER_RAD * np.radians(1.0 / 60.0)
EXACT_UM = 1e-6
TRACED_UM = 1e-5
OTHER_PLANE_UM = 0.02
INTERPOLATED_UM = 2e-3
SHARE = 0.005
"""Largest share of the light of a PSF that another wavefront may misplace."""

MEASURED = {
    "kind": "zernike_set",
    "measurements": [
        {
            "pupil_diameter_mm": 5.0,
            "wavelength_nm": 555.0,
            "h_deg": h_deg,
            "zernike_um": {
                "2,0": 1.1 + 0.002 * h_deg,
                "2,2": -0.12 + 0.0012 * h_deg**2,
                "2,-2": 0.08,
                "3,1": 0.05 - 0.011 * h_deg,
                "3,-1": -0.09,
                "4,0": 0.07,
            },
        }
        for h_deg in (0.0, 20.0, -20.0)
    ],
}
TENTH_ORDER = {
    "kind": "zernike",
    "pupil_diameter_mm": 6.0,
    "wavelength_nm": 555.0,
    "zernike_um": {
        **{"2,0": 1.6, "2,2": -0.2, "3,-1": -0.9, "3,3": 0.2, "4,0": 0.3, "5,1": 0.1},
        **{"7,3": 0.05, "8,0": -0.04, "9,-5": 0.02, "10,2": 0.03},
    },
}
"""Wavefronts are traced with 36 terms, and the residual has 66."""

SCHEMATIC = "escudero_sanz_navarro_1999"
PEOPLE = {name: name for name in preset_names()} | {
    "measured": json.dumps(MEASURED),
    "tenth order": json.dumps(TENTH_ORDER),
}


def nodes_near(nodes_deg, wanted_deg):
    return np.array([np.abs(nodes_deg - deg).argmin() for deg in wanted_deg])


def frames_of(profile):
    """The store of an `EyeFilter` after a frame, and the state of one of its nodes."""
    with EyeFilter(profile, CAMERA, engine="native") as eye_filter:
        shape = (CAMERA.height_px, CAMERA.width_px)
        color, depth_m = np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf)
        view = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
        eye_filter.filter(color, depth_m.astype(np.float32), **view)
        store = eye_filter._eyes.eyes[0].stores[0].store.store
    plan = store.plan
    pupil = int(np.abs(plan.pupils_mm - 4.1).argmin())
    across, along = nodes_near(plan.h_deg, H_DEG), nodes_near(plan.v_deg, V_DEG)
    fields = (along[:, None] * len(plan.h_deg) + across).ravel()
    h_deg, v_deg = np.meshgrid(plan.h_deg[across], plan.v_deg[along])
    state = {
        "h_deg": h_deg.ravel(),
        "v_deg": v_deg.ravel(),
        "pupil_diameter_mm": float(plan.pupils_mm[pupil]),
        "wavelength_nm": float(store.spec.channel_wavelengths_nm[GREEN]),
    }
    assert plan.accommodations_dpt[0] == 0.0
    groups = store.groups_of([(pupil, 0)])[0] + fields
    return store, groups, state


def of_nodes(store, groups, state):
    """Coefficients of an object at infinity, at nodes of a store."""
    found = store.nodes.wavefronts
    np.testing.assert_array_equal(found.h_deg[groups], state["h_deg"])
    np.testing.assert_array_equal(store.nodes.shrink_ratio[groups], 1.0)
    total_dpt = store.eye.total_defocus_dpt(**state, accommodation_dpt=0.0)
    at_zero, per_dpt = (
        values[groups, GREEN, 0] for values in (found.zernike_um, found.per_dpt_um)
    )
    diameter_mm = found.circle_diameter_mm[groups, GREEN, 0]
    ellipse = found.pupil_ellipse[groups, GREEN, 0]
    return at_zero + total_dpt[:, None] * per_dpt, diameter_mm, ellipse


def of_eye(eye, state):
    states = {**state, "accommodation_dpt": 0.0}
    return eye.wavefronts(**states, total_defocus_dpt=eye.total_defocus_dpt(**states))


def on_circle(zernike_um, diameter_mm, wanted_mm):
    return np.array(
        [
            rescale_pupil(one, radius_ratio=wanted / own)
            for one, own, wanted in zip(zernike_um, diameter_mm, wanted_mm, strict=True)
        ]
    )


def difference_um(found, expected):
    """Largest of all coefficients but piston."""
    return float(np.abs(found - expected)[:, 1:].max())


def kernels(zernike_um, diameter_mm, ellipse, wavelength_nm):
    return [
        compute_psfs(
            one[None],
            pupil_diameter_mm=diameter,
            pupil_ellipse=pupil,
            wavelength_nm=wavelength_nm,
            pixel_pitch_mrad=PIXEL_MRAD,
            # "auto" changes to rays at some blur, which moves 1.5 % of the light.
            method="fourier",
        )[0].kernel
        for one, diameter, pupil in zip(zernike_um, diameter_mm, ellipse, strict=True)
    ]


def misplaced_light(one, other):
    large, small = sorted((one, other), key=len, reverse=True)
    margin = (len(large) - len(small)) // 2
    return np.abs(large - np.pad(small, margin)).sum() / 2.0


def of_commands(source, state, *options):
    """What `psf` computes with, and what `wavefront` prints, in each direction."""
    in_pupil, at_cornea, radius_mm = [], [], []
    view = {key: state[key] for key in ("pupil_diameter_mm", "wavelength_nm")}
    for h_deg, v_deg in zip(state["h_deg"], state["v_deg"], strict=True):
        used = _state(source, 0.0, **view, h_deg=h_deg, v_deg=v_deg)
        in_pupil.append(used.zernike_um)
        words = {
            "--pupil-mm": view["pupil_diameter_mm"],
            "--wavelength-nm": view["wavelength_nm"],
            "--h-deg": h_deg,
            "--v-deg": v_deg,
        }
        ended = run_command(
            "wavefront",
            source,
            *(f"{name}={float(value)!r}" for name, value in words.items()),
            *options,
            "--json",
        )
        assert ended.returncode == 0, ended.stderr
        printed = json.loads(ended.stdout)
        at_cornea.append(printed["zernike_um"])
        radius_mm.append(printed["zernike_radius_mm"])
    return np.array(in_pupil), np.array(at_cornea), np.array(radius_mm)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PEOPLE, SCHEMATIC])
def test_every_way_has_the_same_wavefront(name, capsys):
    source = PEOPLE.get(name, name)
    profile = load_profile(source)
    store, groups, state = frames_of(profile)
    nodes_deg = np.unique(state["h_deg"]), np.unique(state["v_deg"])
    given = {
        "pupil_diameters_mm": [state["pupil_diameter_mm"]],
        "wavelengths_nm": [state["wavelength_nm"]],
        "field_range_deg": tuple((a.min(), a.max()) for a in nodes_deg),
    }
    exact, _ = prepare_eye(profile, **given, nodes_deg=nodes_deg)
    assert exact.accommodation_dpt(0.0, pupil_diameter_mm=4.0) == 0.0
    expected = of_eye(exact, state)
    in_pupil_um, diameter_mm = expected.zernike_um, expected.circle_diameter_mm
    table = field_table(profile, **state)
    psf_um, at_cornea_um, radius_mm = of_commands(source, state)
    found = {
        "field": difference_um(table.in_pupil.zernike_um, in_pupil_um),
        "psf": difference_um(psf_um, in_pupil_um),
        "wavefront": difference_um(
            on_circle(at_cornea_um, radius_mm, table.zernike_radius_mm),
            table.zernike_um,
        ),
    }
    usual = of_eye(prepare_eye(profile, **given)[0], state)
    ways = {
        "prepare_eye": (
            usual.zernike_um,
            usual.circle_diameter_mm,
            usual.pupil_ellipse,
        ),
        "EyeFilter": of_nodes(store, groups, state),
    }
    sharp = kernels(
        in_pupil_um, diameter_mm, expected.pupil_ellipse, state["wavelength_nm"]
    )
    lost = {}
    for way, wave in ways.items():
        found[way] = difference_um(on_circle(*wave[:2], diameter_mm), in_pupil_um)
        pictures = kernels(*wave, state["wavelength_nm"])
        lost[way] = max(map(misplaced_light, pictures, sharp))
    with capsys.disabled():
        print(
            f"\n{name}, {state['pupil_diameter_mm']:.2f} mm: um "
            + ", ".join(f"{way} {value:.1e}" for way, value in found.items())
            + "; light "
            + ", ".join(f"{way} {value:.4f}" for way, value in lost.items())
        )
    for way in ("field", "psf"):
        assert found[way] < EXACT_UM, way
    if profile.is_given:
        direct = wavefront_grid(
            eye_model(profile).relaxed,
            fields_deg=np.stack([state["h_deg"], state["v_deg"]], axis=-1),
            wavelengths_nm=[state["wavelength_nm"]],
            pupil_diameters_mm=[state["pupil_diameter_mm"]],
            plane="pupil",
        )
        direct_um = direct.zernike_um.reshape(-1, N_TERMS)
        direct_mm = 2.0 * direct.zernike_radius_mm.ravel()
        traced_um = on_circle(direct_um, direct_mm, diameter_mm)
        assert difference_um(traced_um, in_pupil_um) < TRACED_UM
        assert found["wavefront"] < OTHER_PLANE_UM
    else:
        assert found["wavefront"] < EXACT_UM
    for way in ways:
        assert found[way] < INTERPOLATED_UM, way
        assert lost[way] < SHARE, way
