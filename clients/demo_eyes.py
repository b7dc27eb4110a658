"""The eyes of the demo, with captions on what to look for in each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DemoEye:
    """A preset, its title, and two lines of caption for each scene."""

    preset: str
    title: str
    look_for: dict[str, tuple[str, str]]


EYES = (
    DemoEye(
        "emmetropia",
        "Emmetropia: no error",
        {
            "courtyard": (
                "Sharp where it looks; the sides of the view,",
                "and leaves and cup close by, are softer.",
            ),
            "primitives": (
                "It looks at the letter: that is sharp.",
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
                "menus are gone, lamps are faint discs.",
            ),
            "primitives": (
                "The ball is sharp, the cube nearly,",
                "the letter is lost in blur.",
            ),
        },
    ),
    DemoEye(
        "astigmatism",
        "Astigmatism, with myopia",
        {
            "courtyard": (
                "More blur than myopia, and wider across than",
                "up and down: upright window bars vanish.",
            ),
            "primitives": (
                "Upright edges and the bars' ends blur more",
                "than the bars' upper and lower edges.",
            ),
        },
    ),
    DemoEye(
        "keratoconus",
        "Keratoconus",
        {
            "courtyard": (
                "Words stay readable but throw a ghost",
                "downward; lamps have tails.",
            ),
            "primitives": (
                "The bars fade above and below, their ends",
                "hardly: the blur is lopsided.",
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
                "upright edges stay crisp.",
            ),
        },
    ),
    DemoEye(
        "post_lasik",
        "After presbyopic LASIK",
        {
            "courtyard": (
                "Near menu and far sign are both readable,",
                "each a little softer than without error.",
            ),
            "primitives": (
                "The letter is nearly sharp; the ball,",
                "close by, is soft and ringed.",
            ),
        },
    ),
)
