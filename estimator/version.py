"""Version of the installed package ocufilter."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ocufilter")
except PackageNotFoundError:
    __version__ = "checkout"
