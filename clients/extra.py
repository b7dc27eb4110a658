"""Install instructions for optional dependencies of the client programs."""

import sys

INSTALL = "pip install 'ocufilter[clients]' && pip install --no-deps pyrender==0.1.45"
"""pyrender is installed without dependencies: it pins a PyOpenGL that is too old."""


def what_to_install(error: ModuleNotFoundError) -> str:
    """Return one line on which package is missing and how to install them all."""
    return f"the package {error.name} is not installed; to render scenes: {INSTALL}"


HEADSET_INSTALL = f"{sys.executable} -m pip install 'ocufilter[headset]'"

WEB_INSTALL = (
    "make web, in a checkout, installs what is missing; elsewhere "
    f"{sys.executable} -m pip install 'ocufilter[web,clients]'"
)
