"""What the service tells about its own process, and the memory that it gives back."""

import ctypes
import resource
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def package_version() -> str:
    """Return the installed version, or ``checkout`` where it is not installed."""
    try:
        return version("ocufilter")
    except PackageNotFoundError:
        return "checkout"


def resident_memory_mb() -> float:
    """Return the memory that this process holds (Linux; 0 elsewhere)."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0

    return pages * resource.getpagesize() / 1e6


def give_memory_back() -> None:
    """Return what was freed to the system (glibc; nothing elsewhere)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
