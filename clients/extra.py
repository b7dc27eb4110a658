"""Install instructions for optional dependencies of the client programs."""

import sys

INSTALL = "pip install 'ocufilter[clients]'"


PYRENDER_INSTALL = "pip install 'ocufilter[pyrender]'"


def what_to_install(error: ModuleNotFoundError, command: str = INSTALL) -> str:
    """Return one line that names the missing package and the command to install it."""
    return f"the package {error.name} is not installed: {command}"


HEADSET_INSTALL = f"{sys.executable} -m pip install 'ocufilter[headset]'"

WEB_INSTALL = (
    "in a checkout, run `make web`; elsewhere, run "
    f"{sys.executable} -m pip install 'ocufilter[web]'"
)
