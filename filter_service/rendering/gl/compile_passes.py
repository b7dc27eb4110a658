"""Warm-up: compile every pass before the first client connects.

A software renderer compiles a shader at its first dispatch, which would delay the first
frames of a new service by half a second.
"""

from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.perfect_eye import change_by_perfect_eye


def compile_passes(renderer: FilterRenderer) -> float:
    """Filter a tiny frame in every variant that clients may request.

    Returns
    -------
    float
        Largest change of a pixel's value; ideally zero.
    """
    return change_by_perfect_eye(renderer)
