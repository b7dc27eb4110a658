"""What the programs that render scenes need beside the service."""

import sys

INSTALL = "pip install 'ocufilter[clients]' && pip install --no-deps pyrender==0.1.45"
"""pyrender apart and without its dependencies: it pins a PyOpenGL that is too old."""


def what_to_install(error: ModuleNotFoundError) -> str:
    """Say in one line which package is missing and how to get all of them."""
    return f"the package {error.name} is not installed; to render scenes: {INSTALL}"


HEADSET_INSTALL = f"{sys.executable} -m pip install 'ocufilter[headset]'"

WEB_INSTALL = (
    "make web, in a checkout, installs what is missing; elsewhere "
    f"{sys.executable} -m pip install 'ocufilter[web,clients]'"
)
