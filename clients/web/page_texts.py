"""Explanations on the page."""

from __future__ import annotations

from collections.abc import Sequence

from clients.scenarios import Scenario

PICTURE_HELP = (
    "Left of the divider is the scene, right of it what the eye sees; in a comparison, "
    "A and B, which “Side by side” shows whole. Drag the divider, or hold a button to "
    "see one of them alone. A click focuses the eye on what is there. The picture is "
    "sharpest in the direction of the gaze, the center: objects at the side are "
    "blurred, as in every eye."
)
CONDITIONS_HELP = (
    "They hold for all pictures. “Light” sets the pupil by the luminance of the "
    "surroundings and the age (Watson and Yellott 2012). Blur is smaller and acuity "
    "higher through a pupil of 3 mm than through a wide one: uncorrected, 2.50 dpt of "
    "myopia read 0.20 through 3.3 mm, where people read 0.17 to 0.19. The focus is the "
    "distance that the eye looks at; “Distance” is that of the letter chart or of a "
    "photograph without depth, which the buttons of “Look at” move, too. The pencil "
    "beside a slider takes a typed value, such as 6 m, 40 cm, 20 ft or 2.5 dpt."
)
HAZE_OFFER = (
    "At night, light that scatters in the eye lies as a veil around lamps; these "
    "entries leave it out."
)
NORMAL = (
    "Every eye is sharp only where it looks: what is at the side is blurred, and dark "
    "edges have colored fringes. People do not notice either in their own sight."
)
NOT_MEDICAL = (
    "Not a medical device: for demonstration and research. It models the optics of an "
    "eye, not its health, and does not replace an examination."
)


def scenario_text(scenario: Scenario, changed: Sequence[str] = ()) -> str:
    """Return what a scenario shows, what it leaves out, and what was changed in it."""
    told = f"{scenario.sees} {scenario.leaves_out}"
    if changed:
        told = f"Changed since: {', '.join(changed)}. As the scenario started: {told}"
    return f"A: {scenario.a.title}. B: {scenario.b.title}. {told}"
