"""Version of the installed package ocufilter."""

from estimator import __version__ as _version

__version__ = _version
