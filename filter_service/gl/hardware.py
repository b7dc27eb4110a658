"""Which renderers are a GPU, and whether there may be one: no driver is started."""

import sys
from pathlib import Path

RENDER_NODES = ("/dev/dri/renderD*", "/dev/nvidia[0-9]*", "/dev/dxg")
"""What a GPU's driver puts into a Linux system; the last is Windows' subsystem."""


def may_have_gpu(root: Path = Path("/")) -> bool:
    """Return whether a driver is there; elsewhere than on Linux one may always be.

    It takes a fraction of a millisecond, where to open a context takes 0.2 s.
    """
    if not sys.platform.startswith("linux"):
        return True
    return any(any(root.glob(pattern[1:])) for pattern in RENDER_NODES)


SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr", "software")


def is_software_renderer(name: str) -> bool:
    """Return whether a renderer of this name is the processor."""
    return any(word in name.lower() for word in SOFTWARE_RENDERERS)
