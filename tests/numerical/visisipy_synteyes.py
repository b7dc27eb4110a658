"""Eyes of SyntEyes from visisipy, an independent package, traced by optiland.

    pip install visisipy==0.5.0      in an environment of its own
    python tests/numerical/visisipy_synteyes.py visisipy_synteyes.json

It needs nothing of this project.  The file has moments of 200,000 eyes that visisipy
draws, and a few eyes: the parameters, the biometry that visisipy makes of them, and
where rays along the axis land on its retina, with the cornea to the eighth and to the
sixth order.  Its lens has no higher orders, and its
retina is 0.2 mm before the axial length.
"""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import visisipy
from optiland.rays import RealRays
from visisipy.backend import get_backend
from visisipy.models.catalog.synteyes import SyntEyesEyeModel
from visisipy.synteyes.synteyes import (
    SyntEye3D,
    convert_to_single_orig_synteyes,
    create_mgmm_data,
    load_synteyes_model_data,
    sample_retina_curvature,
)

N_DRAWN, N_EYES, SEED = 200_000, 12, 20231
N_MOMENTS = 6
N_CORNEA, N_TO_SIXTH = 45, 28
CORNEA_MM, KERATOMETER_MM = 3.25, 1.5
WAVELENGTH_UM = 0.555
START_MM = -5.0
HEIGHTS_MM = (0.5, 1.0, 1.5, 2.0)
AZIMUTHS_DEG = (20.0, 110.0, 245.0)


def rays_mm() -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of rays along the axis."""
    height = np.repeat([0.0, *HEIGHTS_MM], len(AZIMUTHS_DEG))
    azimuth = np.tile(np.radians(AZIMUTHS_DEG), len(HEIGHTS_MM) + 1)
    return height * np.cos(azimuth), height * np.sin(azimuth)


def traced(eye: SyntEye3D) -> list[list[float]]:
    """Return x, y and z, mm, of the rays on the retina, as optiland traces them."""
    SyntEyesEyeModel(eye).build()
    optic = get_backend().optic
    x, y = rays_mm()
    one, zero = np.ones_like(x), np.zeros_like(x)
    rays = RealRays(x, y, START_MM * one, zero, zero, one, one, WAVELENGTH_UM * one)
    optic.surfaces.trace(rays)
    return np.stack([rays.x, rays.y, rays.z], axis=-1).tolist()


def keratometry_dpt(drawn: np.ndarray) -> np.ndarray:
    """Return K (n,) on a ring of 3 mm, by the radial polynomials written out."""
    model = load_synteyes_model_data()
    terms = model.avg_ec_orig[0] + 1e-3 * drawn[:, 6:] @ model.conv_ec_orig.T
    squared = np.array([0.0, (KERATOMETER_MM / CORNEA_MM) ** 2])
    radial = {
        4: np.sqrt(3.0) * (2 * squared - 1),
        12: np.sqrt(5.0) * (6 * squared**2 - 6 * squared + 1),
        24: np.sqrt(7.0) * (20 * squared**3 - 30 * squared**2 + 12 * squared - 1),
    }
    apex_mm, ring_mm = sum(terms[:, [j]] * values for j, values in radial.items()).T
    sag_mm = ring_mm - apex_mm
    return 337.5 * 2.0 * sag_mm / (KERATOMETER_MM**2 + sag_mm**2)


def to_sixth_order(terms: np.ndarray) -> np.ndarray:
    """Return terms of the cornea (91, ...) without those of higher orders."""
    kept = terms.copy()
    for surface in (0, N_CORNEA):
        kept[surface + N_TO_SIXTH : surface + N_CORNEA] = 0.0
    return kept


def main() -> None:
    """Draw, trace, and write the file."""
    warnings.simplefilter("ignore")
    model = load_synteyes_model_data()
    rng = np.random.default_rng(SEED)
    mixture = (model.mu_orig, model.cov_orig, model.weights_orig)
    drawn = create_mgmm_data(*mixture, N_DRAWN, rng=rng)
    powers_dpt = keratometry_dpt(drawn)
    drawn = np.column_stack([drawn[:, :N_MOMENTS], powers_dpt])
    visisipy.set_backend("optiland")
    visisipy.update_settings(
        fields=[(0.0, 0.0)], wavelengths=[WAVELENGTH_UM], field_type="angle"
    )
    eyes = []
    for parameters in create_mgmm_data(*mixture, N_EYES, rng=rng):
        found, smoother = (
            convert_to_single_orig_synteyes(
                parameters,
                conv_ec=kept(model.conv_ec_orig),
                avg_ec=kept(model.avg_ec_orig[0])[None],
                lens_za=model.lens_za_orig,
            )
            for kept in (np.copy, to_sixth_order)
        )
        (retina,) = sample_retina_curvature(
            [found.biometry.axial_length],
            [found.biometry.retina_thickness],
            model.mu_retina_radii,
            model.cov_retina_radii,
            rng=rng,
        )
        eyes.append(
            {
                "parameters": parameters.tolist(),
                "retina_semi_axes_mm": [
                    float(retina.radius_x),
                    float(retina.radius_y),
                    float(retina.radius_z),
                ],
                "cornea_thickness_mm": float(found.biometry.cornea_thickness),
                "vitreous_depth_mm": float(found.biometry.vitreous_depth),
                "lens_index": float(found.materials.lens_index),
                "on_retina_mm": traced(SyntEye3D.from_synteye(found, retina)),
                "to_sixth_order_mm": traced(SyntEye3D.from_synteye(smoother, retina)),
            }
        )
    x, y = rays_mm()
    content = {
        "about": f"visisipy {visisipy.__version__}, seed {SEED}, {N_DRAWN} eyes",
        "mean": drawn.mean(axis=0).tolist(),
        "deviation": drawn.std(axis=0).tolist(),
        "correlation": np.corrcoef(drawn.T).tolist(),
        "start_mm": np.stack([x, y, START_MM * np.ones_like(x)], axis=-1).tolist(),
        "eyes": eyes,
    }
    Path(sys.argv[1]).write_text(json.dumps(content) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
