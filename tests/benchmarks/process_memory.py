"""Memory of a stream: stores, tables and buffers, and the PSS of every process.

The code reports what stores, tables and buffers take, in this process and through the
service alike.  PSS counts a page that n processes share as a nth, so that the processes
add up.
"""

import os
import socket
import urllib.request
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from clients.service_process import ServiceProcess
from filter_service.filtering.builder import Builder

MB = 10**6
ROLLUP = "/proc/{}/smaps_rollup"
NAMES = {
    "filter_service.service.front_end": "front end",
    "filter_service.service.render_worker_process": "render worker",
    "filter_service.building.worker": "build worker",
}
"""Names of the processes by a word of their command lines."""

METRICS = (
    *("ocufilter_psfs_bytes", "ocufilter_psf_tables_bytes"),
    "ocufilter_frame_buffers_bytes",
)


def pss_mb(pid: int, rollup: str = ROLLUP) -> float | None:
    """Return the proportional memory of a process; None if the kernel hides it."""
    try:
        lines = Path(rollup.format(pid)).read_text(encoding="ascii").splitlines()
        found = next(line for line in lines if line.startswith("Pss:"))
    except (OSError, StopIteration):
        return None
    return int(found.split()[1]) * 1024 / MB


def process_ids(root: int, name: str) -> dict[str, int]:
    """Return a process, which has a name, and all its descendants (Linux)."""
    found, waiting = {name: root}, [root]
    while waiting:
        pid = waiting.pop()
        for task in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, task.read_text().split()):
                with suppress(FileNotFoundError):  # it has ended
                    kind = _kind_of(child)
                    count = sum(other.startswith(kind) for other in found)
                    found[f"{kind} {count + 1}" if count else kind] = child
                    waiting.append(child)
    return found


def _kind_of(pid: int) -> str:
    """Return the name of a process by its command line."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    found = [NAMES[word] for word in words.split("\0") if word in NAMES]
    return found[0] if found else words.split("\0")[0]


@dataclass(frozen=True)
class MemoryUse:
    """Memory at one time, 10^6 bytes.

    Attributes
    ----------
    stores_mb, tables_mb, buffers_mb : float
        Kernels of the streams at all resolutions, tables and nodes of their PSFs, and
        buffers that frames reuse.
    pss_mb : dict
        PSS of each process by name; None where it is not available.
    """

    stores_mb: float
    tables_mb: float
    buffers_mb: float
    pss_mb: dict[str, float | None]

    @classmethod
    def of_builder(cls, builder: Builder) -> Self:
        """Return the memory of this process, and of its build worker."""
        pids = process_ids(os.getpid(), "program")
        return cls(
            *(builder.stores_mb, builder.tables_mb, builder.engine.memory_mb),
            {name: pss_mb(pid) for name, pid in pids.items()},
        )

    @classmethod
    def of_service(cls, service: ServiceProcess, metrics_port: int) -> Self:
        """Return the memory of a service, from its metrics and the kernel."""
        url = f"http://127.0.0.1:{metrics_port}/metrics"
        with urllib.request.urlopen(url, timeout=10.0) as reply:
            lines = reply.read().decode().splitlines()
        values = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
        pids = process_ids(service.process.pid, "supervisor")
        return cls(
            *(float(values[name]) / MB for name in METRICS),
            {name: pss_mb(pid) for name, pid in pids.items()},
        )

    @property
    def total_mb(self) -> float | None:
        """Return the PSS of all processes; None if that of one is not available."""
        known = [value for value in self.pss_mb.values() if value is not None]
        return sum(known) if len(known) == len(self.pss_mb) else None

    @property
    def words(self) -> str:
        """Return the memory in words."""
        parts = (
            f"{name} " + ("not available" if value is None else f"{value:.0f}")
            for name, value in self.pss_mb.items()
        )
        return (
            f"stores {self.stores_mb:.1f} MB, tables {self.tables_mb:.1f}, buffers "
            f"{self.buffers_mb:.0f}; PSS in MB: {', '.join(parts)}"
        )


def free_port() -> int:
    """Return a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
