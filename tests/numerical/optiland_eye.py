"""A random rotationally symmetric eye traced by optiland, an independent package.

    python -m tests.numerical.optiland_eye     writes tests/data/optiland_eye.json

optiland brings VTK and 0.5 GB with it, so it is an extra of its own
(`pip install -c constraints.txt -e .[crosscheck]`): its rays are kept in that file, and
where it is installed a test traces new eyes with it too.
"""

import json
from pathlib import Path

import numpy as np

from estimator.eye.explicit import parse_explicit_eye

FROZEN = Path(__file__).parents[1] / "data" / "optiland_eye.json"
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


def trace_with_optiland(body, rays):
    """Points (n, 6, 3), directions and paths (n, 6) at the five surfaces and stop."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.rays import RealRays

    eye = parse_explicit_eye(body)
    optic = Optic()
    start_z = float(rays[0, 2])
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
            z=surface.z_mm,
            radius=surface.radius_mm[0],
            conic=surface.conic_constant,
            material=IdealMaterial(n=eye.indices[surface.medium_after]),
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
    count = len(rays)
    bundle = RealRays(*rays.T, np.ones(count), np.full(count, WAVELENGTH_NM / 1000.0))
    optic.surfaces.trace(bundle, skip=1)
    group, n_elements = optic.surfaces, len(eye.surfaces) + 2
    stack = {name: np.array(getattr(group, name))[-n_elements:].T for name in "xyzLMN"}
    points = np.stack([stack["x"], stack["y"], stack["z"]], -1)
    directions = np.stack([stack["L"], stack["M"], stack["N"]], -1)
    return points, directions, np.array(group.opd)[-n_elements:].T


def main():
    """Write the frozen eye, rays and optiland's answer."""
    rng = np.random.default_rng(SEED)
    body, rays = random_eye(rng), random_rays(rng, 24)
    points, directions, paths = trace_with_optiland(body, rays)
    content = {
        "source": "optiland 0.6.3, by python -m tests.numerical.optiland_eye",
        "wavelength_nm": WAVELENGTH_NM,
        "eye": body,
        "rays": rays.tolist(),
        "points_mm": points.tolist(),
        "directions": directions.tolist(),
        "paths_mm": paths.tolist(),
    }
    FROZEN.write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
