"""Profiles of persons drawn from the population, for the range between people.

A drawn person has everything that the profile does not tell: the periphery and, with a
prescription, the higher orders on the axis.
"""

from dataclasses import replace

from estimator.profiles.parse import EyeProfile

PEOPLE_LIMITS = (2, 1000)
"""Allowed numbers of persons."""


def draws_axis(profile: EyeProfile) -> bool:
    """Return whether a drawn person has higher orders of its own on the axis."""
    return profile.kind == "prescription" and profile.higher_order == "typical"


def draws_periphery(profile: EyeProfile) -> bool:
    """Return whether a drawn person has a periphery of its own."""
    return not profile.is_given and profile.periphery == "people"


def drawn_text(profile: EyeProfile) -> str:
    """Return what differs between drawn persons, and what they have in common."""
    drawn = []
    if draws_axis(profile):
        drawn.append("the higher orders on the axis")
    if draws_periphery(profile):
        drawn.append("the periphery")
    common = "the prescription"
    if profile.kind != "prescription":
        count = len(profile.measurements)
        common = "the measurement on the axis" if count == 1 else "the measurements"
    return f"{' and '.join(drawn)} drawn from the population; {common} unchanged"


def drawn_profiles(profile: EyeProfile, count: int) -> list[EyeProfile]:
    """Return the profiles of persons drawn from the population: samples 0, 1, 2 ...

    Parameters
    ----------
    profile : EyeProfile
        Its own ``sample`` is replaced.
    count : int
        Number of persons, 2 to 1000.

    Raises
    ------
    ValueError
        The count is not allowed, or persons with this profile do not differ.
    """
    low, high = PEOPLE_LIMITS
    if not low <= count <= high:
        raise ValueError(f"people is {count}; allowed: {low} to {high}")
    if not (draws_axis(profile) or draws_periphery(profile)):
        raise ValueError(
            f"people: nothing to draw, because {_reason(profile)}; expected a "
            "prescription, or a measured wavefront with 'periphery' people"
        )
    return [replace(profile, sample=k) for k in range(count)]


def _reason(profile: EyeProfile) -> str:
    if profile.is_given:
        return "the profile gives the eye itself"
    known = "the wavefront on the axis is measured"
    if profile.kind == "prescription":
        known = "'higher_order' is none"
    return f"{known} and 'periphery' is model"
