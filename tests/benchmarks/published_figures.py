"""The paper's own times and errors, for rows beside measured ones.

Csoba & Kunkli 2023, tables 7 and 8 (on axis) and 10 (off axis), 1280x720 on a TITAN Xp;
Barsky's method ran on the processor.  The errors are of 8-bit images against a
reference that shares their accumulation rule.
"""

from dataclasses import dataclass

HARDWARE = "NVIDIA TITAN Xp"

CONDITIONS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)

ON_AXIS = {  # method: scene: (ms, dB) per condition
    "Barsky": {
        "Primitives": (
            (21930, 31.92),
            (12330, 33.39),
            (11980, 33.61),
            (17100, 33.64),
            (15530, 31.53),
            (16460, 31.07),
        ),
        "San Miguel": (
            (13410, 33.70),
            (13510, 33.52),
            (13290, 33.89),
            (14620, 32.61),
            (15220, 30.81),
            (11860, 30.89),
        ),
    },
    "predecessor": {
        "Primitives": (
            (24.68, 46.52),
            (21.73, 46.80),
            (26.51, 47.07),
            (27.08, 45.74),
            (24.50, 45.55),
            (21.29, 45.76),
        ),
        "San Miguel": (
            (16.13, 46.29),
            (23.06, 50.75),
            (30.62, 49.35),
            (24.66, 48.91),
            (17.09, 45.51),
            (20.60, 48.10),
        ),
    },
    "paper on-axis": {
        "Primitives": (
            (10.57, 46.43),
            (9.53, 46.77),
            (7.51, 47.09),
            (12.93, 45.77),
            (9.38, 45.53),
            (8.67, 45.73),
        ),
        "San Miguel": (
            (7.43, 46.14),
            (8.66, 50.60),
            (10.70, 49.33),
            (9.87, 48.83),
            (6.81, 45.45),
            (8.73, 47.95),
        ),
    },
}

OFF_AXIS_PRIMITIVES = (
    (20.9, 45.6),
    (14.7, 45.1),
    (13.5, 45.4),
    (19.6, 44.3),
    (13.4, 44.8),
    (24.4, 44.3),
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
