"""The paper's own times and errors of estimating eyes and aberrations.

Csoba & Kunkli 2023, tables 4 and 5.  "Previous" is the pattern search for the eye, the
smallest spot for the focus, and ray tracing for the aberrations, which is its own
reference; "proposed" are the networks.  Errors are means over 27 terms (um), or over
the changes of lens and chamber (mm); the found eyes were traced with their own circles.
"""

from dataclasses import dataclass

from tests.benchmarks.published_figures import CONDITIONS

HARDWARE = "AMD Ryzen 7 1700 3.00 GHz"
"""The networks ran in TensorFlow on it (its section 7.1, and the times of figure 1)."""

STEPS = ("eye", "focus", "on-axis", "off-axis")

SECONDS = {  # step: (previous, proposed) per condition; table 4
    "eye": (
        *((3521, 0.079), (6270, 0.088), (7306, 0.064)),
        *((10642, 0.061), (4582, 0.073), (4696, 0.085)),
    ),
    "focus": (
        *((77.53, 0.046), (46.17, 0.056), (56.19, 0.063)),
        *((35.62, 0.051), (59.33, 0.065), (32.97, 0.059)),
    ),
    "on-axis": (
        *((25.51, 0.170), (24.10, 0.134), (21.06, 0.129)),
        *((30.61, 0.159), (28.44, 0.146), (31.72, 0.175)),
    ),
    "off-axis": (
        *((213.45, 0.638), (250.39, 0.512), (208.38, 0.548)),
        *((207.81, 0.643), (201.71, 0.583), (194.82, 0.617)),
    ),
}

ERRORS = {  # step: (target, previous, proposed) per condition; table 5
    "eye": (
        *((0.0000, 0.0008, 0.0044), (0.2005, 0.0010, 0.0047), (0.3440, 0.0011, 0.0038)),
        *((0.2894, 0.0076, 0.0083), (0.1655, 0.0361, 0.0048), (0.0583, 0.0029, 0.0024)),
    ),
    "focus": (
        *((0.3171, 0.0, 0.0111), (0.0411, 0.0, 0.0058), (0.0122, 0.0, 0.0020)),
        *((0.2000, 0.0, 0.0046), (0.2130, 0.0, 0.0174), (0.4124, 0.0, 0.0033)),
    ),
    "on-axis": (
        *((0.1484, 0.0, 0.0079), (0.2137, 0.0, 0.0093), (0.3376, 0.0, 0.0093)),
        *((0.3167, 0.0, 0.0107), (0.4254, 0.0, 0.0143), (0.2506, 0.0, 0.0086)),
    ),
    "off-axis": (
        *((0.7013, 0.0, 0.0152), (0.7009, 0.0, 0.0152), (0.7031, 0.0, 0.0149)),
        *((0.7872, 0.0, 0.0182), (0.4156, 0.0, 0.0208), (0.9545, 0.0, 0.0197)),
    ),
}

PREVIOUS, PROPOSED = "previous", "proposed"
PUBLISHED_AS = {
    # (step, method of ours): which of theirs stands beside it
    ("eye", "search"): PREVIOUS,
    ("focus", "search"): PREVIOUS,
    ("on-axis", "exact"): PREVIOUS,
    ("off-axis", "exact"): PREVIOUS,
    **{(step, "network"): PROPOSED for step in STEPS},
}


@dataclass(frozen=True)
class PublishedStep:
    """Figures of one step for one condition.

    ``error`` and ``target`` are in um, or mm for the focus; ``target`` is the mean
    absolute value that was to be found.
    """

    method: str
    median_ms: float
    error: float
    target: float
    hardware: str = HARDWARE


def published_step(step: str, condition: str, method: str) -> PublishedStep | None:
    """Figures beside a method of ours; None where there are none."""
    theirs = PUBLISHED_AS.get((step, method))
    if theirs is None:
        return None
    number, which = CONDITIONS.index(condition), (PREVIOUS, PROPOSED).index(theirs)
    target, *errors = ERRORS[step][number]
    time_ms = 1000.0 * SECONDS[step][number][which]
    return PublishedStep(theirs, time_ms, errors[which], target)
