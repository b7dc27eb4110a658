"""The nodes of the paper's tables 4 and 5, and what tracing and networks say of them.

A step's nodes are rows in the columns of its network (`networks.card.INPUTS`), so that
every method answers exactly the same questions: 42 foci (6 pupils x 7 distances), 126
wavefronts on the axis of the focused eyes (x 3 wavelengths), 627 of the relaxed eye
over the field (3 wavelengths x 19 azimuths x 11 elevations, 5 mm).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import AQUEOUS, DIAMETER, accommodated_vectors, pack_eyes
from estimator.eye.parameters import N_PARAMETERS, EyeParameters
from estimator.eye.tracing import eye_indices, refraction_of_vectors
from estimator.networks import inference as networks
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, RGB_WAVELENGTHS_NM
from estimator.wavefront.aberrations import eyes_aberrations
from estimator.wavefront.compiled import FieldResults, magnifications
from estimator.wavefront.nodes import N_AZIMUTHS, N_RINGS
from tests.numerical.spot_focus import focus_by_spot

PUPILS_MM = np.linspace(2.0, 7.0, 6)
FOCUSES_DPT = np.linspace(0.125, 8.125, 7)
WAVELENGTHS_NM = np.array(RGB_WAVELENGTHS_NM)
H_DEG = np.linspace(-45.0, 45.0, 19)
V_DEG = np.linspace(-25.0, 25.0, 11)
FIELD_PUPIL_MM = 5.0

ROOT_TOLERANCE_MM = 1e-12


def product_rows(*axes: NDArray) -> NDArray[np.float64]:
    """Every combination of the axes, as rows (n, n_axes), the last axis fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def focus_nodes(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (42, 47): a relaxed eye (45,), pupil, focus."""
    rows = product_rows(PUPILS_MM, FOCUSES_DPT)
    return np.column_stack([np.repeat(vector[None], len(rows), axis=0), rows])


def focused_vectors(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eyes (42, 45) focused exactly, in the order of `focus_nodes`."""
    nodes = focus_nodes(vector)
    diameters_mm = vector[DIAMETER] + traced_focus(nodes)[:, 0]
    return accommodated_vectors(vector, lens_diameter_mm=diameters_mm)


def on_axis_nodes(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (126, 49): a focused eye, pupil, wavelength, and the axis."""
    focused = np.repeat(focused_vectors(vector), WAVELENGTHS_NM.size, axis=0)
    rows = product_rows(PUPILS_MM, FOCUSES_DPT, WAVELENGTHS_NM)
    fields_deg = np.zeros((len(rows), 2))
    return np.column_stack([focused, rows[:, 0], rows[:, 2], fields_deg])


def off_axis_nodes(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (627, 49): the relaxed eye, 5 mm, wavelength, azimuth, elevation."""
    rows = product_rows(WAVELENGTHS_NM, H_DEG, V_DEG)
    pupils_mm = np.full(len(rows), FIELD_PUPIL_MM)
    return np.column_stack(
        [np.repeat(vector[None], len(rows), axis=0), pupils_mm, rows]
    )


NODES = {"focus": focus_nodes, "on-axis": on_axis_nodes, "off-axis": off_axis_nodes}
NETWORK_OF = {
    **{"eye": "eye", "focus": "focus"},
    **{"on-axis": "aberration", "off-axis": "aberration"},
}


def _pupil_groups(nodes: NDArray[np.float64]):
    """Pupil, and which rows have it."""
    for pupil_mm in np.unique(nodes[:, N_PARAMETERS]):
        yield float(pupil_mm), np.flatnonzero(nodes[:, N_PARAMETERS] == pupil_mm)


def traced_focus(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change (n, 2), mm, of lens and chamber of one relaxed eye, as the service has it.

    Pupil by pupil, each a table of traces and secant steps.
    """
    changes_mm = np.empty((len(nodes), 2))
    parameters = EyeParameters.from_vector(nodes[0, :N_PARAMETERS])
    for pupil_mm, rows in _pupil_groups(nodes):
        eye = AccommodatingEye(parameters, pupil_diameter_mm=pupil_mm)
        used_dpt = eye.accommodations_at_cornea_dpt(-nodes[rows, -1])
        changes_mm[rows] = eye.changes_mm(used_dpt)
    return changes_mm


def reference_focus(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same, each by a bracketed root of the traced refraction."""
    vector = nodes[0, :N_PARAMETERS]
    diameters_mm = np.empty(len(nodes))
    for pupil_mm, rows in _pupil_groups(nodes):
        eye = AccommodatingEye(
            EyeParameters.from_vector(vector), pupil_diameter_mm=pupil_mm
        )
        # as far as light passes at the cornea, where the networks' focus is counted
        nearest_dpt = eye.accommodations_at_cornea_dpt(np.array([-np.inf]))
        ends_mm = eye.lens_diameters_mm([0.0, *nearest_dpt])

        def off_dpt(diameter_mm, focus_dpt, pupil_mm=pupil_mm):
            return focus_dpt + refraction_dpt([diameter_mm], vector, pupil_mm)[0]

        for row in rows:
            focus_dpt = float(nodes[row, -1])
            off = [off_dpt(end_mm, focus_dpt) for end_mm in ends_mm]
            if off[0] <= 0.0 or off[1] >= 0.0:  # beyond the far or the near point
                diameters_mm[row] = ends_mm[0] if off[0] <= 0.0 else ends_mm[1]
                continue
            diameters_mm[row] = brentq(
                off_dpt, *ends_mm, args=(focus_dpt,), xtol=ROOT_TOLERANCE_MM
            )
    return _changes_mm(vector, diameters_mm)


def refraction_dpt(
    diameters_mm, vector: NDArray[np.float64], pupil_mm: float
) -> NDArray[np.float64]:
    """Traced M (n,) of an eye with these lens diameters (n,), its volume kept."""
    return refraction_of_vectors(
        accommodated_vectors(vector, lens_diameter_mm=diameters_mm),
        pupil_diameter_mm=pupil_mm,
    )


def _changes_mm(vector, diameters_mm) -> NDArray[np.float64]:
    found = accommodated_vectors(vector, lens_diameter_mm=diameters_mm)
    return (found - vector)[:, [DIAMETER, AQUEOUS]]


def network_focus(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same by network, both of its answers as they are."""
    changes_mm = networks.network_focus(
        nodes[:, :N_PARAMETERS],
        pupil_diameter_mm=nodes[:, -2],
        focus_dpt=nodes[:, -1],
    )
    return np.column_stack(changes_mm)


def spot_focus(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same by the smallest spot: another criterion than the refraction."""
    parameters = EyeParameters.from_vector(nodes[0, :N_PARAMETERS])
    diameters_mm = [
        focus_by_spot(
            parameters, focus_dpt=focus_dpt, pupil_diameter_mm=pupil_mm
        ).lens_diameter_mm
        for pupil_mm, focus_dpt in nodes[:, -2:].tolist()
    ]
    return _changes_mm(nodes[0, :N_PARAMETERS], diameters_mm)


def reached_dpt(
    nodes: NDArray[np.float64], changes_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where eyes (n,) with these changes (n, 2) are focused, traced: -M, dpt.

    As in the service the lens does not grow, and the chamber follows from it.
    """
    vector = nodes[0, :N_PARAMETERS]
    diameters_mm = vector[DIAMETER] + np.minimum(changes_mm[:, 0], 0.0)
    found_dpt = np.empty(len(nodes))
    for pupil_mm, rows in _pupil_groups(nodes):
        found_dpt[rows] = -refraction_dpt(diameters_mm[rows], vector, pupil_mm)
    return found_dpt


def traced_aberrations(
    nodes: NDArray[np.float64], *, n_rings: int = N_RINGS, n_azimuths: int = N_AZIMUTHS
) -> FieldResults:
    """Aberrations (n,) of rows of the aberration network's columns."""
    packed = pack_eyes(nodes[:, :N_PARAMETERS])
    pupils_mm, wavelengths_nm, h_deg, v_deg = nodes[:, N_PARAMETERS:].T
    wavelength_nm, number = np.unique(wavelengths_nm, return_inverse=True)
    indices = np.array([eye_indices(value) for value in wavelength_nm.tolist()])
    ratios = magnifications(packed, eye_indices(REFERENCE_WAVELENGTH_NM))
    return eyes_aberrations(
        packed,
        indices[number],
        stop_diameters_mm=pupils_mm / ratios,
        h_deg=h_deg,
        v_deg=v_deg,
        n_rings=n_rings,
        n_azimuths=n_azimuths,
    )


def network_aberrations(nodes: NDArray[np.float64]) -> networks.PupilAberrations:
    """The same by network."""
    pupils_mm, wavelengths_nm, h_deg, v_deg = nodes[:, N_PARAMETERS:].T
    return networks.network_aberrations(
        nodes[:, :N_PARAMETERS],
        pupil_diameter_mm=pupils_mm,
        wavelength_nm=wavelengths_nm,
        h_deg=h_deg,
        v_deg=v_deg,
    )


def in_domain(step: str, nodes: NDArray[np.float64]) -> tuple[NDArray[np.bool_], str]:
    """Which rows (n,) a step's network was trained for, and what the others lack.

    The reason is that of the row that lacks least: what all the others lack, too.
    """
    card = networks.load_network(NETWORK_OF[step]).card
    excesses = [card.outside(row[None]) for row in nodes]
    inside = np.array([not found for found in excesses])
    lacking = [found for found in excesses if found]
    return inside, str(min(lacking, key=len)[0]) if lacking else ""
