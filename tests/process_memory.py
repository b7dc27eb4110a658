"""Processes by name, and their memory as PSS.

PSS counts a page that n processes share as an nth, so that the processes add up.
"""

from contextlib import suppress
from pathlib import Path

MB = 10**6
ROLLUP = "/proc/{}/smaps_rollup"
NAMES = {
    "filter_service.service.front_end": "front end",
    "filter_service.service.render_worker_process": "render worker",
    "filter_service.building.worker": "build worker",
}
"""Names of the processes by a word of their command lines."""


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
