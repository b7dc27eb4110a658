"""The paper's own times and errors of estimating eyes and aberrations.

Csoba & Kunkli 2023, tables 4 and 5.  "Previous" is the pattern search for the eye, the
smallest spot for the focus, and ray tracing for the aberrations, which is its own
reference; "proposed" are the networks.  Errors are means over 27 terms (um), or over
the changes of lens and chamber (mm); the found eyes were traced with their own circles.
"""

from dataclasses import dataclass

from tests.benchmarks.paper_page.published import table
from tests.benchmarks.published_figures import CONDITIONS

HARDWARE = "AMD Ryzen 7 1700 3.00 GHz"
"""The networks ran in TensorFlow on it (its section 7.1, and the times of figure 1)."""

STEPS = ("eye", "focus", "on-axis", "off-axis")

PREVIOUS, PROPOSED = "previous", "proposed"

SECONDS = {  # step: (previous, proposed) per condition; table 4
    step: tuple((own[PREVIOUS][eye], own[PROPOSED][eye]) for eye in CONDITIONS)
    for step, own in table(4).items()
}

ERRORS = {  # step: (target, previous, proposed) per condition; table 5
    step: tuple(
        (own["target"][eye], own[PREVIOUS][eye], own[PROPOSED][eye])
        for eye in CONDITIONS
    )
    for step, own in table(5).items()
}

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
