"""The demo's eyes, with captions that say what to look for in each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DemoEye:
    """A preset, its title, and two caption lines for each scene."""

    preset: str
    title: str
    look_for: dict[str, tuple[str, str]]


EYES = (
    DemoEye(
        "emmetropia",
        "Emmetropia: no refractive error",
        {
            "courtyard": (
                "Sharp at the fixated distance; the periphery",
                "and the leaves and cup close by are softer.",
            ),
            "primitives": (
                "Focused on the letter, which is sharp.",
                "The ball, 12 to 19 cm away, is soft.",
            ),
        },
    ),
    DemoEye(
        "myopia",
        "Myopia, -6 D",
        {
            "courtyard": (
                "Nothing beyond 16 cm can be sharp: sign and",
                "menus are unreadable, lamps are faint discs.",
            ),
            "primitives": (
                "The ball is sharp, the cube nearly so,",
                "and the letter is lost in blur.",
            ),
        },
    ),
    DemoEye(
        "astigmatism",
        "Astigmatism, with myopia",
        {
            "courtyard": (
                "More blur than myopia, and more across than",
                "up and down: vertical window bars vanish.",
            ),
            "primitives": (
                "Vertical edges and the ends of the bars blur",
                "more than their upper and lower edges.",
            ),
        },
    ),
    DemoEye(
        "keratoconus",
        "Keratoconus",
        {
            "courtyard": (
                "Words stay readable but have a ghost image",
                "below; lamps have tails.",
            ),
            "primitives": (
                "The bars fade above and below, their ends",
                "hardly: the blur is asymmetric.",
            ),
        },
    ),
    DemoEye(
        "cataract",
        "Cataract (wavefront only)",
        {
            "courtyard": (
                "Letters smear downward. The haze of a",
                "cataract is not part of a wavefront.",
            ),
            "primitives": (
                "Upper and lower edges of the bars fade,",
                "vertical edges stay crisp.",
            ),
        },
    ),
    DemoEye(
        "post_lasik",
        "After presbyopic LASIK",
        {
            "courtyard": (
                "The near menu and the far sign are both",
                "readable, a little softer than in emmetropia.",
            ),
            "primitives": (
                "The letter is nearly sharp; the ball close by",
                "is soft, with rings.",
            ),
        },
    ),
)
