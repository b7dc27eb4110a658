"""The paper's own times and errors, for rows beside measured ones.

Csoba & Kunkli 2023, tables 7 and 8 (on axis) and 10 (off axis), 1280x720 on a TITAN Xp;
Barsky's method ran on the processor.  The errors are of 8-bit images against a
reference that shares their accumulation rule.
"""

from dataclasses import dataclass

from tests.benchmarks.paper_page.published import table

HARDWARE = "NVIDIA TITAN Xp"

CONDITIONS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)

ON_AXIS_METHODS = ("Barsky", "predecessor", "paper on-axis")
_MS, _DB, _OFF_AXIS = table(7), table(8), table(10)

ON_AXIS = {  # method: scene: (ms, dB) per condition
    method: {
        scene: tuple((_MS[method][scene][eye], own_db[eye]) for eye in CONDITIONS)
        for scene, own_db in _DB[method].items()
    }
    for method in ON_AXIS_METHODS
}


def _number(cell: str) -> float:
    return float(cell.split()[0])


OFF_AXIS_PRIMITIVES = tuple(
    (_number(_OFF_AXIS["Primitives"]["quality"][eye]), _number(own_db))
    for eye, own_db in _OFF_AXIS["Primitives"]["dynamic"].items()
)
"""Table 10: time printed under the quality setup, error under the dynamic one; those of
the previous methods are 1.0 to 1.9 h and 29.2 to 33.8 dB."""


SCENES = {"primitives": "Primitives", "courtyard": "San Miguel"}
"""Their scene beside each of ours: the same one, or one as rich."""

OFF_AXIS = "paper off-axis"


@dataclass(frozen=True)
class Published:
    """Figures of a method, condition and scene.

    Attributes
    ----------
    psnr_srgb8_db : float
        Of 8-bit images: it stands beside our 8-bit figures, never beside linear ones.
    """

    method: str
    scene: str
    median_ms: float
    psnr_srgb8_db: float
    table: str
    hardware: str = f"{HARDWARE}, 1280x720"


def published(method: str | None, condition: str, scene: str) -> Published | None:
    """Figures beside those of one of our scenes; None where there are none.

    Parameters
    ----------
    method : str, optional
        Key of `ON_AXIS`, or `OFF_AXIS`.
    """
    number, theirs = CONDITIONS.index(condition), SCENES[scene]
    if method in ON_AXIS:
        figures = ON_AXIS[method][theirs][number]
        return Published(method, theirs, *figures, "tables 7 and 8")
    if method == OFF_AXIS and theirs == "Primitives":
        return Published(method, theirs, *OFF_AXIS_PRIMITIVES[number], "table 10")
    return None
