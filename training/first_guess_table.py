"""Compute the table of initial eyes of the estimation.

    python -m training.first_guess_table

Writes ``eye_table.json``: eyes that are estimated from the mean eye, for a range of
refractions and aberrations.
"""

import json
from typing import Any

from estimator.estimate.estimation import TABLE_FILE, estimate_eye
from estimator.eye.parameters import mean_vector
from estimator.optics.prescription import zernike_from_power_vector
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import nm_from_index
from estimator.profiles.parse import parse_profile

TABLE_PUPIL_MM = 5.0
DECIMALS = 6

REFRACTIONS_DPT = (-15.0, -12.0, -9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0)
ASTIGMATISMS_DPT = ((1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5))
"""(J0, J45), each with a refraction of -3 dpt."""

ABERRATIONS_UM = (
    # {index j: um at 5 mm}, each with a refraction of -3 dpt
    *({7: 0.8}, {7: -0.8}, {8: 0.8}, {8: -0.8}),  # coma
    *({7: -0.7, 6: 0.4, 12: 0.12}, {7: -1.5, 12: 0.2}),  # a cone below the axis
    *({12: 0.4}, {12: -0.3}),  # after surgery
)
ABERRATED_REFRACTION_DPT = -3.0


def _wanted_bodies() -> list[dict[str, Any]]:
    """Return the profiles of the eyes in the table."""

    def body(
        m_dpt: float,
        j0_dpt: float = 0.0,
        j45_dpt: float = 0.0,
        extra: dict[int, float] | None = None,
    ) -> dict[str, Any]:
        zernike_um = zernike_from_power_vector(
            m_dpt, j0_dpt, j45_dpt, zernike_radius_mm=TABLE_PUPIL_MM / 2.0
        )
        for j, added_um in (extra or {}).items():
            zernike_um[j] += added_um
        terms = {
            "{},{}".format(*nm_from_index(j)): float(c)
            for j, c in enumerate(zernike_um)
            if c != 0.0
        }
        return {
            "kind": "zernike",
            "pupil_diameter_mm": TABLE_PUPIL_MM,
            "wavelength_nm": REFERENCE_WAVELENGTH_NM,
            "zernike_um": terms,
        }

    m_dpt = ABERRATED_REFRACTION_DPT
    return (
        [body(m) for m in REFRACTIONS_DPT]
        + [body(m_dpt, *powers) for powers in ASTIGMATISMS_DPT]
        + [body(m_dpt, extra=extra) for extra in ABERRATIONS_UM]
    )


def main() -> None:
    """Estimate every eye of the table and write the file."""
    rows = []
    for wanted in _wanted_bodies():
        found = estimate_eye(parse_profile(wanted), start_vectors=mean_vector()[None])
        values = found.parameters.to_mapping()
        rows.append({name: round(value, DECIMALS) for name, value in values.items()})
        print(f"{wanted['zernike_um']}: error {found.mean_abs_error_um:.2g} um")
    source = (
        "python -m training.first_guess_table; parameters by name, for a 5 mm pupil"
    )
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    TABLE_FILE.write_text(
        f'{{"source": "{source}",\n "eyes": [\n  {lines}\n ]}}\n', encoding="utf-8"
    )


if __name__ == "__main__":
    main()
