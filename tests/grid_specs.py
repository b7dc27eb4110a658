"""Specs of PSF caches for tests and benchmarks, given by flat keywords."""

from filter_service.camera import Camera
from filter_service.planning.grid import GridSpec
from filter_service.settings import FilterSettings, setting_types


def grid_spec(camera=None, *, mode="on-axis", **given):
    """Return a spec; keywords are settings, or parts of the camera and the spec."""
    if camera is None:
        parts = (given.pop(name) for name in ("width_px", "height_px", "tangents"))
        camera = Camera(*parts)
    settings = {name: given.pop(name) for name in setting_types() if name in given}
    return GridSpec(camera, FilterSettings(mode=mode, **settings), **given)
