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
    """Build a scene.

    Raises
    ------
    ValueError
        If no scene has that name.
    """
    if name not in SCENE_BUILDERS:
        raise ValueError(
            f"scene {name!r} is unknown; choose from {sorted(SCENE_BUILDERS)}"
        )
    return SCENE_BUILDERS[name]()
