"""Lookup of scenes by name."""

from collections.abc import Callable

from clients.scenes import courtyard, primitives
from clients.scenes.scene import Scene

SCENE_BUILDERS: dict[str, Callable[[], Scene]] = {
    "primitives": primitives.build,
    "courtyard": courtyard.build,
}
"""Builder function of each scene."""


def build_scene(name: str) -> Scene:
    """Build a scene by its name.

    Raises
    ------
    ValueError
        If no scene has that name.
    """
    if name not in SCENE_BUILDERS:
        names = ", ".join(sorted(SCENE_BUILDERS))
        raise ValueError(f"unknown scene {name!r}; expected one of: {names}")
    return SCENE_BUILDERS[name]()
