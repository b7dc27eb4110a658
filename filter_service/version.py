"""Version of the installed package ocufilter."""

from estimator import version

__version__ = version.__version__
