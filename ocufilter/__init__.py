"""The public API: how a scene looks through a particular person's eye.

    from ocufilter import Camera, EyeFilter

    camera = Camera.from_fov(50.0, width_px=640, height_px=360)
    with EyeFilter("myopia", camera) as eye_filter:
        seen = eye_filter.filter(
            color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0
        )

`EyeFilter` filters frames in your own process, `FilterClient` sends them to a service,
and `load_profile` and `prepare_eye` turn a description of an eye into its wavefronts
and PSFs.  `errors` contains the exceptions.  `__init__.pyi` lists all names by subject.

Importing this package takes milliseconds: each name is loaded when it is first used.
The packages `filter_service`, `clients` and `estimator` define these names, which
can also be imported from there.

    __main__  the command line, as ``python -m ocufilter``
    torch     an eye as a layer of PyTorch; requires the extra ``ocufilter[torch]``
"""

from importlib import import_module
from typing import Any

_PACKAGES = ("filter_service", "clients", "estimator")
# not lazy_loader.attach_stub, which only loads names from within a package
_HOMES = {name: p for p in _PACKAGES for name in import_module(p).__all__}

__all__ = sorted([*_HOMES, "errors"])


def __getattr__(name: str) -> Any:
    if name == "errors":
        value: Any = import_module("filter_service.errors")
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'ocufilter' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
