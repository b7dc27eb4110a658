"""The layer's library and its manifest, by which the loader of OpenXR finds it.

The loader reads explicit layers, which a program's environment names, and implicit
ones, which it loads into all programs unless their environment forbids it.
"""

from __future__ import annotations

import ctypes
import json
import os
from pathlib import Path
from typing import Literal

NAME = "XR_APILAYER_ocufilter_eye"
OFF_VARIABLE = "DISABLE_XR_APILAYER_OCUFILTER_EYE"
LIBRARY_VARIABLE = "OCUFILTER_LAYER_LIBRARY"
ENTRY_POINT = "xrNegotiateLoaderApiLayerInterface"
HEADERS = "libopenxr-dev libgl-dev libegl-dev libx11-dev"

Kind = Literal["explicit", "implicit"]


class NoLayer(Exception):
    """The layer's library is missing or cannot be loaded."""


def library() -> Path:
    """Return the path of the layer's library.

    Raises
    ------
    NoLayer
        If it was not built, or cannot be loaded.
    """
    given = os.environ.get(LIBRARY_VARIABLE)
    path = Path(given) if given else Path(__file__).with_name("_layer.so")
    if not path.is_file():
        raise NoLayer(
            "the layer was not built; it requires Linux, a C compiler and the headers "
            f"of OpenXR, OpenGL and X11 (Debian: apt install gcc {HEADERS}); then "
            "install ocufilter again"
        )
    try:
        getattr(ctypes.CDLL(str(path)), ENTRY_POINT)
    except (OSError, AttributeError) as error:
        raise NoLayer(f"{path} is not a layer for this machine: {error}") from None
    return path.resolve()


def manifest(kind: Kind) -> str:
    """Return the manifest of the layer, JSON."""
    found = {
        "file_format_version": "1.0.0",
        "api_layer": {
            "name": NAME,
            "library_path": str(library()),
            "api_version": "1.1",
            "implementation_version": "1",
            "description": "Shows each frame as a simulated eye would see it",
            # For runtimes without depth, where the layer removes it.
            "instance_extensions": [
                {
                    "name": "XR_KHR_composition_layer_depth",
                    "extension_version": "6",
                    "entrypoints": [],
                }
            ],
            **({"disable_environment": OFF_VARIABLE} if kind == "implicit" else {}),
        },
    }
    return json.dumps(found, indent=2) + "\n"


def folder(kind: Kind) -> Path:
    """Return the user's folder of manifests."""
    data = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local/share")
    return Path(data) / "openxr/1/api_layers" / f"{kind}.d"


def manifest_path(kind: Kind) -> Path:
    """Return the path of the installed manifest."""
    return folder(kind) / f"{NAME}.json"


def search_path(own: Path) -> str:
    """Return a value of XR_API_LAYER_PATH with another folder.

    The variable replaces the loader's own folders, which are therefore named as well.
    """
    given = os.environ.get("XR_API_LAYER_PATH")
    if given:
        return os.pathsep.join((str(own), given))
    settings = os.environ.get("XDG_CONFIG_DIRS") or "/etc/xdg"
    data = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    system = [*settings.split(":"), "/etc", *data.split(":")]
    folders = [Path(base) / "openxr/1/api_layers/explicit.d" for base in system]
    return os.pathsep.join(map(str, (own, folder("explicit"), *folders)))


def layered_environment(own: Path) -> dict[str, str]:
    """Return the environment of a program with the layer, next to the program.

    Parameters
    ----------
    own : Path
        Folder that contains the manifest.
    """
    others = os.environ.get("XR_ENABLE_API_LAYERS")
    return {
        **os.environ,
        "XR_API_LAYER_PATH": search_path(own),
        "XR_ENABLE_API_LAYERS": os.pathsep.join(filter(None, (NAME, others))),
    }
