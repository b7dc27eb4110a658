"""Eyes for the tests of tracing: from the reference data, and one without symmetry."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.optics.gradients import PolynomialGradient
from estimator.optics.media import WavelengthPolynomial
from estimator.optics.surfaces import EyeSurfaces, Retina, Surface, rotation_matrix
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    rescale_pupil,
    zernike_values,
)

DATA = Path(__file__).parents[1] / "data"


def reference():
    """Content of eye_reference.json; its conventions are in ``meta.doc``."""
    return json.loads((DATA / "eye_reference.json").read_text(encoding="utf-8"))


def _sphere(radius_mm, conic_constant, z_mm, medium_after):
    return Surface((radius_mm, radius_mm), conic_constant, z_mm, medium_after)


def navarro(data, *, retina_z_mm=None, indices=None):
    """The Navarro / Escudero-Sanz eye of the reference data."""
    eye = data["eye"]
    return EyeSurfaces(
        surfaces=tuple(
            _sphere(s["R"], s["k"], s["z"], s["after"])
            for s in eye["surfaces"]
            if s["name"] != "stop"
        ),
        stop_z_mm=next(s["z"] for s in eye["surfaces"] if s["name"] == "stop"),
        retina=Retina(
            eye["retina_R_mm"],
            0.0,
            eye["retina_z_ESN1999_mm"] if retina_z_mm is None else retina_z_mm,
        ),
        indices=indices,
    )


def case_eye(data, case):
    """Eye of one of ``zernike_cases``."""
    focus_mm = data["paraxial"]["at_555_herzberger"]["axial_length_paraxial_focus_mm"]
    retina_z_mm = {"ESN1999": None, "paraxial555": focus_mm}[case["variant"]]
    table = data["indices"]["ESN1999_table"]
    indices = table["543.0"] if case["wavelength_nm"] == 543.0 else None
    return navarro(data, retina_z_mm=retina_z_mm, indices=indices)


def opticstudio_eye(model):
    """Biconic cornea, conic retina; the eye of the OpticStudio rays."""
    front, back = model["cornea_front"], model["cornea_back"]
    lens_front, lens_back, retina = (
        model[name] for name in ("lens_front", "lens_back", "retina")
    )
    z_mm = np.cumsum([0.0, front["t"], back["t"], lens_front["t"], lens_back["t"]])
    return EyeSurfaces(
        surfaces=(
            Surface((front["Rx"], front["Ry"]), front["k"], 0.0, "cornea"),
            _sphere(back["R"], back["k"], z_mm[1], "aqueous"),
            _sphere(lens_front["R"], lens_front["k"], z_mm[2], "lens"),
            _sphere(lens_back["R"], lens_back["k"], z_mm[3], "vitreous"),
        ),
        stop_z_mm=float(z_mm[2]),
        retina=Retina(retina["R"], retina["k"], float(z_mm[4])),
        indices=model["indices"],
    )


def cartesian_eye():
    """One surface that images infinity without aberration (Descartes)."""
    index, radius_mm = 1.336, 6.0
    surface = Surface((radius_mm, radius_mm), -1.0 / index**2, 0.0, "vitreous")
    focus_mm = radius_mm * index / (index - 1.0)
    return EyeSurfaces(
        (surface,), 2.5, Retina(12.0, 0.0, focus_mm), {"vitreous": index}
    )


def irregular_eye():
    """No symmetry at all: offsets, toric surfaces, tilted and decentered lens."""
    rng = np.random.default_rng(7)
    scale = np.repeat([0.0, 0.04, 0.04, 0.02, 0.02, 0.01, 0.01], range(1, 8))
    lens = {"decentration_mm": (0.2, -0.13), "tilt_deg": (2.5, -1.7)}
    return EyeSurfaces(
        surfaces=(
            Surface(
                (7.6, 7.9),
                -0.3,
                0.0,
                "cornea",
                rotation_deg=23.0,
                offset_mm=rng.uniform(-1.0, 1.0, N_TERMS) * scale,
            ),
            Surface((6.3, 6.6), -0.4, 0.55, "aqueous", rotation_deg=-31.0),
            Surface((10.4, 10.4), -4.0, 3.4, "lens", **lens),
            Surface((-6.2, -6.0), -2.5, 7.4, "vitreous", rotation_deg=12.0, **lens),
        ),
        stop_z_mm=3.4,
        retina=Retina((12.2, 11.7), 0.2, 23.7),
    )


def _angles(matrix):
    """(rotation, tilts) in degrees of a matrix Ry Rx Rz."""
    about_x = math.asin(-matrix[1, 2])
    about_y = math.atan2(matrix[0, 2], matrix[2, 2])
    about_z = math.atan2(matrix[1, 0], matrix[1, 1])
    return math.degrees(about_z), (math.degrees(about_x), math.degrees(about_y))


def turned(eye, angle_deg):
    """The eye turned about the z axis; its retina must be one of revolution."""
    turn = rotation_matrix(rotation_deg=angle_deg, tilt_deg=(0.0, 0.0))

    def turned_surface(surface):
        matrix = rotation_matrix(
            rotation_deg=surface.rotation_deg, tilt_deg=surface.tilt_deg
        )
        rotation_deg, tilt_deg = _angles(turn @ matrix)
        x, y, _ = turn @ np.array([*surface.decentration_mm, 0.0])
        return replace(
            surface,
            rotation_deg=rotation_deg,
            tilt_deg=tilt_deg,
            decentration_mm=(x, y),
        )

    return replace(eye, surfaces=tuple(turned_surface(s) for s in eye.surfaces))


def mirrored(eye):
    """The other eye: x reversed."""

    def mirrored_surface(surface):
        offset_mm = surface.offset_mm
        (x, y), (tilt_x, tilt_y) = surface.decentration_mm, surface.tilt_deg
        return replace(
            surface,
            rotation_deg=-surface.rotation_deg,
            decentration_mm=(-x, y),
            tilt_deg=(tilt_x, -tilt_y),
            offset_mm=None if offset_mm is None else flip_horizontal(offset_mm),
        )

    return replace(eye, surfaces=tuple(mirrored_surface(s) for s in eye.surfaces))


def on_radius(found, radius_mm):
    """Coefficients of a result on another circle, (28,) um."""
    return rescale_pupil(
        found.zernike_um, radius_ratio=radius_mm / found.zernike_radius_mm
    )


def turned_zernike(zernike_um, angle_rad):
    """Coefficients of a wavefront turned counter-clockwise, by refitting values."""
    ring, turn = np.sqrt(np.linspace(0.05, 1.0, 8)), np.arange(16) * np.pi / 8
    x, y = np.outer(ring, np.cos(turn)).ravel(), np.outer(ring, np.sin(turn)).ravel()
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    values = zernike_values(c * x + s * y, c * y - s * x) @ zernike_um
    return np.linalg.lstsq(zernike_values(x, y), values, rcond=None)[0]


def field_axes(h_deg, v_deg):
    """ex, ey, u of CONVENTIONS.md, by cross products."""
    h, v = math.radians(h_deg), math.radians(v_deg)
    u = np.array([math.sin(h) * math.cos(v), math.sin(v), -math.cos(h) * math.cos(v)])
    ex = np.cross(u, [0.0, 1.0, 0.0])
    ex /= np.linalg.norm(ex)
    return ex, np.cross(ex, u), u


def field_of(u):
    """(h, v) in degrees of a unit vector to the source."""
    return math.degrees(math.atan2(u[0], -u[2])), math.degrees(math.asin(u[1]))


def liou_brennan(*, steps=4, **lens):
    """The eye of Liou & Brennan (1997); ``lens`` displaces its three lens surfaces."""
    shift = WavelengthPolynomial((0.0512, -0.1455, 0.0961))

    def homogeneous(index):
        return WavelengthPolynomial((index + 0.0512, -0.1455, 0.0961))

    def gradient(*rows):
        return PolynomialGradient(rows, dispersion=shift, steps=steps)

    return EyeSurfaces(
        surfaces=(
            _sphere(7.77, -0.18, 0.0, "cornea"),
            _sphere(6.40, -0.60, 0.50, "aqueous"),
            replace(_sphere(12.40, -0.94, 3.66, "anterior lens"), **lens),
            replace(_sphere(math.inf, 0.0, 5.25, "posterior lens"), **lens),
            replace(_sphere(-8.10, 0.96, 7.68, "vitreous"), **lens),
        ),
        stop_z_mm=3.66,
        retina=Retina(12.0, 0.0, 23.95),
        media={
            "cornea": homogeneous(1.376),
            "aqueous": homogeneous(1.336),
            "anterior lens": gradient((1.368, 0.049057, -0.015427), (-0.001978,)),
            "posterior lens": gradient((1.407, 0.0, -0.006605), (-0.001978,)),
            "vitreous": homogeneous(1.336),
        },
    )
