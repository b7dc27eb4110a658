"""Batches that are killed in the midst, for a test and a benchmark."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

from tests.source_tree import ROOT

COMMAND = (sys.executable, "-m", "ocufilter", "batch")
MARK = "OCUFILTER_TEST_OUT"


def start(*arguments, **variables):
    """Start a batch, with variables of its environment."""
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def kill(arguments, out, chance):
    """Kill a batch after one to three frames more; half of the time workers, too.

    Returns whether it was at work.
    """
    target = line_count(out) + chance.randint(1, 3)
    process = start(*arguments, "-o", out, **{MARK: str(out)})
    while process.poll() is None and line_count(out) < target:
        time.sleep(0.002)
    time.sleep(chance.uniform(0.0, 0.03))  # somewhere in the next frame
    return kill_now(process, out, chance)


def kill_now(process, out, chance):
    """Kill a batch; half of the time its workers, too.  Return if it was at work."""
    was_at_work = process.poll() is None
    process.kill()
    if chance.random() < 0.5:
        for worker in workers_of(out):
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGKILL)
    process.communicate()
    return was_at_work


def workers_of(out):
    """Return the workers of a batch: their environment names its folder."""
    found = []
    for folder in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{folder}/cmdline", "rb") as file:
                words = file.read().split(b"\0")
            with open(f"/proc/{folder}/environ", "rb") as file:
                ours = os.fsencode(f"{MARK}={out}") in file.read().split(b"\0")
        except OSError:
            continue
        if ours and b"clients.batch.pools" in words:
            found.append(int(folder))
    return found


def line_count(out):
    """Return how many lines the manifest has."""
    path = out / "manifest.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def wait_for_orphans(out, limit_s=20.0):
    """Wait for workers that were left behind, which end by themselves."""
    deadline_s = time.monotonic() + limit_s
    while workers_of(out):
        if time.monotonic() > deadline_s:
            raise TimeoutError("workers outlive their batch")
        time.sleep(0.1)


def pictures(folder):
    """Return the bytes of every file of results."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith((".lock", "manifest"))
    }
