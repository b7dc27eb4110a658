"""Compiles every loop of the service, once on a machine, on all its cores.

    python -m filter_service.filtering.compile_loops

`setup.sh` runs it beside the installation of packages, and `ocufilter prepare` after
that of a wheel; without either the worker does it when it is first idle.  numba keeps
what it compiles beside the sources, or in the user's cache where it may not write
there.  The halves share hardly a loop, so that two processes take half the time.
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
"""What a process can compile, longest first, and what those loops are for."""

POLL_S = 0.1


def compile_loops(progress: Progress) -> None:
    """Compile all parts, as many at once as there are cores.

    Raises
    ------
    BuildFailed
        A process has failed; it has said why.
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
            _take_finished(running, task)
            time.sleep(POLL_S)
    finally:
        for process in running.values():
            process.kill()
            process.communicate()


def _take_finished(running: dict[str, subprocess.Popen[bytes]], task: Task) -> None:
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
    """Compile one part in this process, or read what is compiled already."""
    if part == "tracing":
        from filter_service.building.compile_builds import trace_an_eye

        trace_an_eye()
    elif part == "psfs":
        from filter_service.building.compile_builds import build_without_tracing

        build_without_tracing()
    else:
        from filter_service.rendering.plan_once import plan_once

        plan_once()


def main(arguments: list[str]) -> None:
    """Compile the parts that are named, one after the other; all at once if none is."""
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
