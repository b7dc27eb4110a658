"""Regenerate ``synteyes.json`` from the coefficients that visisipy distributes.

python -m training.synteyes_table .../visisipy/synteyes/modeldata.npz
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from estimator.optics.zernike import N_TERMS
from estimator.profiles.synteyes import SYNTEYES_FILE

REFERENCE = (
    "Rozema, Rodriguez, Navarro & Tassignon, SyntEyes: a higher-order statistical eye "
    "model for healthy eyes, Invest. Ophthalmol. Vis. Sci. 57 (2016), 683"
)
SOURCE = (
    "https://github.com/MREYE-LUMC/visisipy, version 0.5.0: "
    "visisipy/synteyes/modeldata.npz (MIT license); the retina by van Dam et al., ibid."
)
CORNEA_TERMS = 45
"""Terms of each surface of the cornea in the source, to the eighth order."""

DIGITS = 9


def _rounded(values: np.ndarray) -> list[Any]:
    return np.vectorize(lambda v: float(f"{v:.{DIGITS}g}"))(values).tolist()


def _triangle(matrix: np.ndarray) -> list[Any]:
    """Return the rows of the lower triangle of a symmetric matrix."""
    return [_rounded(row[: k + 1]) for k, row in enumerate(matrix)]


def main() -> None:
    """Read the coefficients and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("coefficients", type=Path, help="modeldata.npz of visisipy")
    data = np.load(parser.parse_args().coefficients)
    # The seventh and eighth orders are left out: 0.02 um RMS of the wavefront.
    kept = [*range(N_TERMS), *range(CORNEA_TERMS, CORNEA_TERMS + N_TERMS), -1]
    found = {
        "reference": REFERENCE,
        "source": SOURCE,
        "weights": _rounded(data["weights_orig"]),
        "mean": _rounded(data["mu_orig"]),
        "covariance": [_triangle(data[f"cov_orig{k}"]) for k in (0, 1)],
        "cornea_mean_mm": _rounded(data["avg_ec_orig"][0, kept]),
        "cornea_vectors": _rounded(data["conv_ec_orig"][kept]),
        "lens_mm": _rounded(data["lens_za_orig"]),
        "retina_mean_mm": _rounded(data["mu_retina_radii"]),
        "retina_covariance_mm2": _triangle(data["cov_retina_radii"]),
    }
    SYNTEYES_FILE.write_text(json.dumps(found) + "\n", encoding="utf-8")
    print(f"{SYNTEYES_FILE.name}: {SYNTEYES_FILE.stat().st_size} bytes")


if __name__ == "__main__":
    main()
