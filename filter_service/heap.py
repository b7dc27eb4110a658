"""Memory of this process: its size, and freed memory returned to the system."""

from __future__ import annotations

import ctypes
import mmap
from contextlib import suppress
from pathlib import Path


def resident_memory_mb() -> float:
    """Return the resident memory of this process (Linux; 0 elsewhere)."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * mmap.PAGESIZE / 1e6


def trim_heap() -> None:
    """Return freed memory to the system (glibc; does nothing elsewhere)."""
    with suppress(OSError, AttributeError, TypeError):  # TypeError: on Windows
        ctypes.CDLL(None).malloc_trim(0)
