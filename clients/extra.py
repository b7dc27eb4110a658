"""Install instructions for optional dependencies of the client programs."""

import sys

INSTALL = "pip install 'ocufilter[clients]'"


def what_to_install(error: ModuleNotFoundError) -> str:
    """Return one line that names the missing package and the command to install it."""
    return f"the package {error.name} is not installed: {INSTALL}"


HEADSET_INSTALL = f"{sys.executable} -m pip install 'ocufilter[headset]'"

WEB_INSTALL = (
    "in a checkout, run `make web`; elsewhere, run "
    f"{sys.executable} -m pip install 'ocufilter[web]'"
)
