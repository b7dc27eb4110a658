"""Compile all numba loops of the service, once per machine, on all cores.

    python -m filter_service.filtering.compile_loops

`setup.sh` runs it during an installation from source, `ocufilter prepare` after the
installation of a wheel; otherwise the build worker compiles when it is first idle.
numba caches the results next to the sources, or in the user's cache folder if it cannot
write there.  The parts share hardly any loop, so two processes take half the time.
"""

from __future__ import annotations

import subprocess
import sys
import time

from estimator.threads import thread_count
from filter_service.building.helper_process import end_with_parent, start_module
from filter_service.errors import BuildFailed
from filter_service.progress import Progress, Task

MODULE = "filter_service.filtering.compile_loops"
PARTS = {"tracing": "eyes", "psfs": "PSFs", "frames": "frames"}
"""Parts that one process compiles, longest first, and what their loops compute."""

POLL_S = 0.1


def compile_loops(progress: Progress) -> None:
    """Compile all parts, one process per core.

    Raises
    ------
    BuildFailed
        If a process failed; it has printed the reason.
    """
    waiting, running = list(PARTS), dict[str, subprocess.Popen[bytes]]()
    task = progress.task(
        "Compiling loops, once on this machine", total=len(PARTS), unit="parts"
    )
    try:
        while waiting or running:
            while waiting and len(running) < thread_count():
                part = waiting.pop(0)
                running[part] = start_module(MODULE, part)
            _collect_finished(running, task)
            time.sleep(POLL_S)
    finally:
        for process in running.values():
            process.kill()
            process.communicate()


def _collect_finished(running: dict[str, subprocess.Popen[bytes]], task: Task) -> None:
    for part, process in list(running.items()):
        code = process.poll()
        if code is None:
            continue
        del running[part]
        process.communicate()
        if code != 0:
            raise BuildFailed(f"compiling the loops for {PARTS[part]} failed")
        task.advance()


def compile_part(part: str) -> None:
    """Compile one part in this process, or load it from numba's cache."""
    if part == "tracing":
        from filter_service.building.compile_builds import compile_tracing

        compile_tracing()
    elif part == "psfs":
        from filter_service.building.compile_builds import compile_psfs

        compile_psfs()
    else:
        from filter_service.rendering.plan_once import plan_once

        plan_once()


def main(arguments: list[str]) -> None:
    """Compile the named parts one after the other, or all of them in parallel."""
    if arguments:
        end_with_parent()
        for part in arguments:
            compile_part(part)
    else:
        with Progress("setup", as_lines=True) as progress:
            compile_loops(progress)


if __name__ == "__main__":
    from filter_service import one_blas_thread  # noqa: F401

    main(sys.argv[1:])
