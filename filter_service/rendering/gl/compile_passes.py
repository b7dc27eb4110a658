"""Compiles every pass before the first client comes, by filtering a few pixels.

A software renderer translates a shader at its first dispatch; without this, the first
frames through a new service stall by half a second.
"""

from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.perfect_eye import change_by_perfect_eye


def compile_passes(renderer: FilterRenderer) -> float:
    """Render a tiny frame in every variant that clients may ask for.

    Returns
    -------
    float
        The largest change of a pixel's value, which a perfect eye leaves as it is.
    """
    return change_by_perfect_eye(renderer)
