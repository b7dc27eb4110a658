"""Files as records and instruments export them, made here."""

import math

import numpy as np

PRODUCT = "http://terminology.hl7.org/CodeSystem/ex-visionprescriptionproduct"


def lens(eye, *, code="lens", **elements):
    """Return a lens of a VisionPrescription."""
    product = {"coding": [{"system": PRODUCT, "code": code}]}
    return {"product": product, "eye": eye, **elements}


def vision_prescription(*lenses, **elements):
    """Return a VisionPrescription of R5; by default, of both eyes."""
    lenses = lenses or (
        lens("right", sphere=-2.25, add=1.5, prism=[{"amount": 1.0, "base": "in"}]),
        lens("left", sphere=-1.5, cylinder=-0.75, axis=170, add=1.5),
    )
    return {
        "resourceType": "VisionPrescription",
        "id": "7",
        "status": "active",
        "created": "2026-02-03",
        "patient": {"reference": "Patient/1"},
        "dateWritten": "2026-02-03",
        "prescriber": {"reference": "Practitioner/1"},
        "lensSpecification": list(lenses),
        **elements,
    }


IRX3_TERMS_UM = {
    **{(2, -2): -0.35, (2, 0): 1.6, (2, 2): 0.6},
    **{(3, -3): -0.11, (3, -1): -0.08, (3, 1): 0.03, (3, 3): 0.02},
    (4, 0): 0.09,
}
IRX3_PUPIL_MM = 5.1


def irx3_export(terms_um=None, *, pupil_mm=IRX3_PUPIL_MM, side="OS", **changed):
    """Return an export of an irx3; ``changed`` has values of entries by name.

    The diopters are computed from Thibos's formulas, as the instrument states them.
    """
    terms_um = IRX3_TERMS_UM if terms_um is None else terms_um
    squared = (pupil_mm / 2.0) ** 2
    m_dpt = -4.0 * math.sqrt(3.0) * terms_um[2, 0] / squared
    j0_dpt, j45_dpt = (
        -2.0 * math.sqrt(6.0) * terms_um[2, m] / squared for m in (2, -2)
    )
    axis_deg = math.degrees(np.arctan2(j45_dpt, j0_dpt)) / 2.0 % 180.0
    entries = {
        "Date": "2026/02/03 13:47:01",
        "Software version": "IRX 3 - version 1.2 Beta",
        "Patient": "SOMEBODY",
        "Measurement n°": "1",
        "Side": side,
        "Sphero-cylinder coefficients": "***************",
        "Stimulus vergence (diopter)": "-0.5  ",
        "Time (ms)": "0 ",
        "Zernike Coefficients": "***************",
        "Normalized pupil diameter (mm)": f"{pupil_mm:.3f}",
        "Normalized pupil X position (mm)": "0.000",
        "Normalized pupil Y position (mm)": "0.000",
        **{f"z ({n} , {m}) (µm)": f"{um:.3f}" for (n, m), um in terms_um.items()},
        "Diopter coefficient": "***************",
        "D (2 , -2) Degree": f"{axis_deg:.1f}",
        "D (2 , 0) D": f"{m_dpt:.3f}",
        **changed,
    }
    lines = [f"{name}\t{value}" for name, value in entries.items() if value is not None]
    return "\n".join(lines) + "\n"
