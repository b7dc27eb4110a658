"""Random eyes traced by optiland, an independent package.

    python -m tests.numerical.optiland_eye     writes tests/data/optiland_eye.json,
                                               optiland_forms.json,
                                               optiland_files.json and
                                               optiland_breaks.json

optiland brings VTK and 0.5 GB with it, so it is an extra of its own
(`pip install -c constraints.txt -e .[crosscheck]`): its rays are kept in that file, and
where it is installed a test traces new eyes with it too.
"""

import contextlib
import itertools
import json
import tempfile
import warnings
from pathlib import Path

import numpy as np

from estimator.optics.forms import EvenAsphere, SeparateProfiles, Toroid
from estimator.optics.surfaces import rotation_matrix
from estimator.optics.zernike import N_TERMS, nm_from_index
from tests.numerical.surface_bodies import parsed_eye

FROZEN = Path(__file__).parents[1] / "data" / "optiland_eye.json"
FROZEN_FORMS = FROZEN.with_name("optiland_forms.json")
FROZEN_FILES = FROZEN.with_name("optiland_files.json")
FROZEN_BREAKS = FROZEN.with_name("optiland_breaks.json")
SEED = 20231
WAVELENGTH_NM = 555.0


def random_eye(rng):
    """Body of an explicit eye of revolution, inside and around the human range."""
    cornea, aqueous, lens, vitreous = (
        rng.uniform(0.4, 0.7),
        rng.uniform(2.2, 3.6),
        rng.uniform(3.5, 4.8),
        rng.uniform(15.0, 18.0),
    )
    radii_mm = (
        rng.uniform(6.8, 8.8),
        rng.uniform(5.8, 7.2),
        rng.uniform(8.0, 13.0),
        -rng.uniform(5.0, 7.5),
    )
    conics = (
        rng.uniform(-0.8, 0.2),
        rng.uniform(-0.9, 0.3),
        rng.uniform(-6.0, -1.0),
        rng.uniform(-4.0, -0.5),
    )
    depths_mm = np.cumsum([0.0, cornea, aqueous, lens, vitreous])
    media = ("cornea", "aqueous", "lens", "vitreous")
    return {
        "surfaces": [
            {"radius_mm": r, "conic_constant": k, "z_mm": z, "medium_after": m}
            for r, k, z, m in zip(radii_mm, conics, depths_mm[:4], media, strict=True)
        ],
        "stop_z_mm": float(depths_mm[2]),
        "retina": {
            "radius_mm": -rng.uniform(11.0, 13.5),
            "conic_constant": rng.uniform(-0.4, 0.4),
            "z_mm": float(depths_mm[4]),
        },
        "indices": {
            "cornea": rng.uniform(1.36, 1.39),
            "aqueous": rng.uniform(1.33, 1.35),
            "lens": rng.uniform(1.40, 1.44),
            "vitreous": rng.uniform(1.33, 1.35),
        },
    }


def formed_eye(rng, form, *, conic_constant=None, radii_mm=None, turned=True):
    """A random eye whose cornea and lens have one form, turned and decentered.

    ``form`` is a function of a scale, 1 in front and smaller behind.
    """
    body = random_eye(rng)
    lens = {
        "decentration_mm": rng.uniform(-0.3, 0.3, 2).tolist(),
        "tilt_deg": rng.uniform(-4.0, 4.0, 2).tolist(),
    }
    for i, surface in enumerate(body["surfaces"]):
        surface |= lens if turned and i >= 2 else {}
        if i in (0, 3):
            surface["form"] = form(1.0 if i == 0 else 0.3)
        if conic_constant is not None:
            surface["conic_constant"] = conic_constant
        if turned:
            surface["rotation_deg"] = rng.uniform(-60.0, 60.0)
        if radii_mm and i in (0, 3):
            ratio = rng.uniform(*radii_mm)
            surface["radius_mm"] = [surface["radius_mm"], surface["radius_mm"] * ratio]
        if surface.get("form") is None:
            surface.pop("form", None)
    return body


def formed_eyes(rng):
    """Bodies of eyes with every form that optiland has, by name."""

    def asphere(scale):
        powers = np.array([2e-3, -3e-4, 2e-5, -1e-6, 4e-8, -1e-9, 2e-11, -3e-13])
        return {"kind": "even_asphere", "coefficients": (scale * powers).tolist()}

    def profiles(_):
        return {"kind": "separate_profiles", "conic_constants": [-0.4, 0.2]}

    return {
        "tilted conic": formed_eye(rng, lambda _: None),
        "even asphere": formed_eye(rng, asphere),
        "even asphere, centered": formed_eye(rng, asphere, turned=False),
        "toroid": formed_eye(rng, lambda _: {"kind": "toroid"}, radii_mm=(0.9, 1.1)),
        "separate profiles": formed_eye(rng, profiles, radii_mm=(0.9, 1.1)),
        # for paraboloids optiland's biconic is that of OpticStudio
        "toric paraboloid": formed_eye(
            rng, lambda _: None, conic_constant=-1.0, radii_mm=(0.9, 1.1)
        ),
        "offset": _offset_eye(rng),
    }


def _offset_eye(rng):
    body = formed_eye(rng, lambda _: None)
    terms = np.repeat([0.0, 0.02, 0.02, 0.01, 0.01], range(1, 6))
    body["surfaces"][0]["offset_mm"] = [
        *(terms * rng.uniform(-1.0, 1.0, 15)),
        *([0.0] * 13),
    ]
    return body


def random_rays(rng, count=60):
    """Skew rays (count, 6) from 5 mm before the eye, up to 35 deg and 2.5 mm off."""
    angle, turn = rng.uniform(0.0, 35.0, count), rng.uniform(0.0, 2 * np.pi, count)
    sine = np.sin(np.radians(angle))
    direction = np.stack(
        [sine * np.cos(turn), sine * np.sin(turn), np.cos(np.radians(angle))], -1
    )
    aim = np.zeros((count, 3))
    aim[:, :2] = rng.uniform(-1.7, 1.7, (count, 2))
    aim[:, 2] = 3.0
    start = aim - direction * (8.0 / direction[:, 2:])
    return np.concatenate([start, direction], axis=1)


def _optiland_angles(surface):
    """Angles about x, y and z of optiland, which turns about x, then y, then z."""
    matrix = rotation_matrix(
        rotation_deg=surface.rotation_deg, tilt_deg=surface.tilt_deg
    )
    return {
        "rx": np.arctan2(matrix[2, 1], matrix[2, 2]),
        "ry": -np.arcsin(matrix[2, 0]),
        "rz": np.arctan2(matrix[1, 0], matrix[0, 0]),
    }


def _optiland_shape(surface):
    """Arguments of a surface's shape, and its type."""
    rx_mm, ry_mm = surface.radius_mm
    conic, form = surface.conic_constant, surface.form
    exact = {"tol": 1e-14, "max_iter": 200}
    if isinstance(form, EvenAsphere):
        coefficients = list(form.coefficients)
        shape = {"radius": rx_mm, "conic": conic, "coefficients": coefficients}
        return {"surface_type": "even_asphere", **shape, **exact}
    radii = {"radius_x": rx_mm, "radius_y": ry_mm}
    if isinstance(form, Toroid):
        return {"surface_type": "toroidal", "conic": conic, **radii, **exact}
    if isinstance(form, SeparateProfiles) or rx_mm != ry_mm:
        kx, ky = form.conic_constants if form else (conic, conic)
        assert form or conic == -1.0, "a biconic of optiland is another surface"
        conics = {"conic_x": kx, "conic_y": ky}
        return {"surface_type": "biconic", **radii, **conics, **exact}
    if surface.offset_mm is not None:
        # optiland's terms have the OSA order and its normalization
        order = [nm_from_index(j) for j in range(N_TERMS)]
        norms = [np.sqrt((2 - (m == 0)) * (n + 1)) for n, m in order]
        terms = {
            "coefficients": list(surface.offset_mm / norms),
            "norm_radius": surface.offset_radius_mm,
            "zernike_type": "standard",
        }
        shape = {"radius": rx_mm, "conic": conic}
        return {"surface_type": "zernike", **shape, **terms, **exact}
    return {"radius": rx_mm, "conic": conic}


def optic_of(body, start_z):
    """The eye as an optic of optiland."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    eye = parsed_eye(body)
    optic = Optic()
    optic.surfaces.add(index=0, z=start_z, radius=np.inf, comment="start")
    index = 1
    for surface in eye.surfaces:
        if surface.z_mm == eye.stop_z_mm:
            before = eye.indices[eye.surfaces[index - 2].medium_after]
            optic.surfaces.add(
                index=index,
                z=surface.z_mm,
                radius=np.inf,
                is_stop=True,
                material=IdealMaterial(n=before),
            )
            index += 1
        optic.surfaces.add(
            index=index,
            x=surface.decentration_mm[0],
            y=surface.decentration_mm[1],
            z=surface.z_mm,
            material=IdealMaterial(n=eye.indices[surface.medium_after]),
            **_optiland_angles(surface),
            **_optiland_shape(surface),
        )
        index += 1
    optic.surfaces.add(
        index=index,
        z=eye.retina.z_mm,
        radius=eye.retina.radius_mm[0],
        conic=eye.retina.conic_constant,
        material=IdealMaterial(n=eye.indices["vitreous"]),
    )
    optic.add_wavelength(value=WAVELENGTH_NM / 1000.0, is_primary=True)
    return optic


def trace_with_optiland(body, rays):
    """Points (n, 6, 3), directions and paths (n, 6) at the five surfaces and stop."""
    from optiland.rays import RealRays

    eye, optic = parsed_eye(body), optic_of(body, float(rays[0, 2]))
    count = len(rays)
    bundle = RealRays(*rays.T, np.ones(count), np.full(count, WAVELENGTH_NM / 1000.0))
    optic.surfaces.trace(bundle, skip=1)
    group, n_elements = optic.surfaces, len(eye.surfaces) + 2
    stack = {name: np.array(getattr(group, name))[-n_elements:].T for name in "xyzLMN"}
    points = np.stack([stack["x"], stack["y"], stack["z"]], -1)
    directions = np.stack([stack["L"], stack["M"], stack["N"]], -1)
    return points, directions, np.array(group.opd)[-n_elements:].T


def _traced(body, rays):
    points, directions, paths = trace_with_optiland(body, rays)
    return {
        "eye": body,
        "rays": rays.tolist(),
        "points_mm": points.tolist(),
        "directions": directions.tolist(),
        "paths_mm": paths.tolist(),
    }


def saved_files(body):
    """The files that optiland writes of an eye: its JSON, and .zmx where it can."""
    from optiland.fileio import save_optiland_file, save_zemax_file

    optic = optic_of(body, -20.0)
    optic.set_aperture("EPD", 4.0)
    optic.set_field_type("angle")
    optic.add_field(y=0)
    for before, behind in itertools.pairwise(optic.surfaces):
        # the .zmx writer reads thicknesses, which optiland leaves 0 beside positions
        before.thickness = float(behind.geometry.cs.z - before.geometry.cs.z)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "eye.json"
        save_optiland_file(optic, str(path))
        found = {"json": json.loads(path.read_text(encoding="utf-8"))}
        with contextlib.suppress(NotImplementedError), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of glasses without a catalog
            path = path.with_suffix(".zmx")
            save_zemax_file(optic, str(path))
            found["zmx"] = path.read_text(encoding="latin-1")
    return found


# ----- .zmx files with coordinate breaks

BROKEN_HEAD = (
    "MODE SEQ\nUNIT MM X W X CM MR CPMM\nENPD 3.0\nFTYP 0 0 1 1 0 0 0\n"
    "WAVM 1 0.555 1\nPWAV 1\nXFLN 0\nYFLN 0\nFWGN 1\n"
)
BROKEN_INDICES = (1.0, 1.0, 1.376, *[1.3374] * 3, 1.42, *[1.336] * 3)
"""Indices behind the surfaces of a broken eye, without its breaks."""


def coordinate_break(shift_mm, tilts_deg, *, order=0):
    """Lines of a coordinate break."""
    parts = enumerate([*shift_mm, *tilts_deg, order], 1)
    return ["TYPE COORDBRK", *(f"PARM {k} {v!r}" for k, v in parts if v), "DISZ 0"]


def single_breaks(shift_mm, tilts_deg, *, order=0):
    """Lines of breaks of one part each, which have one meaning in every program."""
    turns = [np.where(np.arange(3) == k, tilts_deg, 0.0).tolist() for k in range(3)]
    parts = [(shift_mm, [0.0] * 3), *(([0.0, 0.0], turn) for turn in turns)]
    return [coordinate_break(*part) for part in (parts[::-1] if order else parts)]


def broken_file(rng, *, single, turned):
    """A .zmx file of an eye whose cornea, stop, lens and retina are tilted.

    ``single`` writes breaks of one part each, ``turned`` tilts the whole eye.
    """

    def element(*lines, radius=0.0, to=0.0, index=None, conic=0.0):
        curvature = 1.0 / radius if radius else 0.0
        glass = [f"GLAS ___BLANK 1 0 {index} 0 0 0 0 0 0 0"] if index else []
        lines = lines or ("TYPE STANDARD",)
        shape = [f"CURV {curvature!r}", f"DISZ {to}", f"CONI {conic}"]
        blocks.append([*lines, *shape, *glass])

    def tilted(part):
        blocks.extend(single_breaks(*part[:2], order=part[2]) if single else [])
        blocks.extend([] if single else [coordinate_break(*part[:2], order=part[2])])

    def drawn(shift_mm, tilt_deg, turn_deg, order=0):
        tilts = rng.uniform(-1.0, 1.0, 3) * [tilt_deg, tilt_deg, turn_deg]
        shift = rng.uniform(-shift_mm, shift_mm, 2)
        return np.round(shift, 4).tolist(), np.round(tilts, 4).tolist(), order

    def undone(shift, tilts, order):
        return [-v for v in shift], [-v for v in tilts], 1 - order

    blocks = [["TYPE STANDARD", "CURV 0.0", "DISZ INFINITY"]]
    element(to=8.0)
    whole, cornea = drawn(0.5, 8, 30), drawn(0.3, 4, 60, 1)
    stop, lens, retina = drawn(0.2, 3, 20), drawn(0.3, 5, 90), drawn(0.3, 4, 10, 1)
    if turned:
        tilted(whole)
    tilted(cornea)
    element(radius=7.8, to=0.5, index=1.376, conic=-0.3)
    element(radius=6.5, to=-0.5, index=1.3374, conic=-0.4)
    tilted(undone(*cornea))
    element(to=3.5, index=1.3374)
    tilted(stop)
    element("TYPE STANDARD", "STOP", to=0.05, index=1.3374)
    tilted(lens)
    toroid = ("TYPE TOROIDAL", "PARM 1 11.0")
    element(*toroid, radius=11.5, to=3.7, index=1.42, conic=-1.2)
    element(radius=-6.0, to=-3.7, index=1.336, conic=-1.0)
    tilted(undone(*lens))
    element(to=19.6, index=1.336)
    tilted(retina)
    element(radius=-12.0)
    surfaces = (
        "".join(f"  {line}\n" for line in [f"SURF {number}", *block])[2:]
        for number, block in enumerate(blocks)
    )
    return BROKEN_HEAD + "".join(surfaces)


def traced_breaks(text, rays):
    """What optiland traces through a file: points and paths, and the stop's axes.

    optiland 0.6.3 composes several tilts of one break in another order than
    OpticStudio and ignores order flags, so the breaks must have one part each.
    """
    from optiland.fileio import load_zemax_file
    from optiland.materials import IdealMaterial
    from optiland.rays import RealRays

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "eye.zmx"
        # where optiland looks for the radius of rotation
        path.write_text(text.replace("PARM 1 11.0", "PARM 2 11.0"), encoding="utf-8")
        surfaces = load_zemax_file(str(path)).surfaces
    for index, surface in zip(BROKEN_INDICES, surfaces, strict=True):
        surface.material_post = IdealMaterial(n=index)
        surface.geometry.tol, surface.geometry.max_iter = 1e-14, 200
    count = len(rays)
    bundle = RealRays(*rays.T, np.ones(count), np.full(count, WAVELENGTH_NM / 1000.0))
    surfaces.trace(bundle, skip=1)
    stop = next(surface for surface in surfaces if surface.is_stop)
    at_mm, axes = stop.geometry.cs.get_effective_transform()
    points = np.stack([np.array(getattr(surfaces, name)) for name in "xyz"], -1)
    kept = [1, 2, 4, 5, 6, 8]  # without planes that refract nothing
    return {
        "rays": rays.tolist(),
        "points_mm": np.moveaxis(points, 0, 1)[:, kept].tolist(),
        "paths_mm": np.array(surfaces.opd).T[:, kept].tolist(),
        "stop_mm": np.ravel(at_mm).tolist(),
        "stop_axes": np.array(axes).tolist(),
    }


def broken_files():
    """Files with breaks, in both ways, and what optiland traces."""
    found = {}
    for name, turned in (("tilted parts", False), ("tilted eye", True)):
        files = {
            way: broken_file(
                np.random.default_rng(SEED + 2), single=way == "single", turned=turned
            )
            for way in ("single", "several")
        }
        rays = random_rays(np.random.default_rng(SEED + 3), 12)
        rays[:, 2] += 8.0  # the eye is behind a dummy surface
        found[name] = {"zmx": files, **traced_breaks(files["single"], rays)}
    return found


def main():
    """Write the frozen eyes, rays and optiland's answer."""
    head = {
        "source": "optiland 0.6.3, by python -m tests.numerical.optiland_eye",
        "wavelength_nm": WAVELENGTH_NM,
    }
    rng = np.random.default_rng(SEED)
    body, rays = random_eye(rng), random_rays(rng, 24)
    content = {**head, **_traced(body, rays)}
    FROZEN.write_text(json.dumps(content) + "\n", encoding="utf-8")
    rng = np.random.default_rng(SEED + 1)
    bodies = formed_eyes(rng)
    eyes = {name: _traced(body, random_rays(rng, 12)) for name, body in bodies.items()}
    text = json.dumps({**head, "eyes": eyes})
    FROZEN_FORMS.write_text(text + "\n", encoding="utf-8")
    files = {name: saved_files(body) for name, body in bodies.items()}
    text = json.dumps({**head, "files": files})
    FROZEN_FILES.write_text(text + "\n", encoding="utf-8")
    text = json.dumps({**head, "files": broken_files()})
    FROZEN_BREAKS.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
