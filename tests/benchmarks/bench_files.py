"""Malformed files: time and memory to read them, and the errors reported.

Valid files of all kinds that are read - pictures, depth, arrays, OpenEXR, profiles,
lens files, spectra, lists, calibrations, states, manifests, videos, glTF, stored eyes,
configurations, keys, links of the page, data sets - are changed: bytes flipped, cut,
removed and repeated, sizes that claim much, numbers and words replaced, brackets
nested, values of JSON replaced by extreme numbers and other types.  Profiles are also
drawn from the JSON Schema.  20,000 are read by processes of their own, and 100 given
to `ocufilter` as a program.  Errors: of readers, what is raised beside the documented
errors and what libraries write to stderr; of the program, an exit code that is
neither 2 with one line on stderr nor 0; of all, processes that die, the longest read
in s of the processor and the most memory in MB.
"""

import json
import logging
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Timer

import numpy as np

from tests.benchmarks.harness import ROOT, Row, Run
from tests.benchmarks.rows import row_of
from tests.file_mutants import Kind, kinds, mutant

N_READS, N_COMMANDS = 20_000, 100
QUICK_READS, QUICK_COMMANDS = 60, 2
MINUTES = 2
N_PROCESSES = 2
COMMAND_S = 60.0
MAX_READ_S, MAX_MEMORY_MB = 5.0, 1000.0
"""What a file may cost: processor time, as other work shares the machine."""

WAITING_S = 60.0
"""A read that takes so long in all is one that hangs."""

ADDRESS_SPACE_BYTES = 6 << 30
"""Of a reading process, so that a file that asks for more is found and not the machine
brought down; memory itself is measured."""

VALID, REFUSED = "valid", "refused"
MAX_CHARACTERS = 5000
"""Length limit of a message."""

TEMPORARY = "/dev/shm" if os.path.isdir("/dev/shm") else None
REFERENCE = f"at most {MAX_READ_S:g} s, {MAX_MEMORY_MB:g} MB"


# --- reads ----------------------------------------------------------------------


def read_some(name: str, first: int, count: int, folder: Path) -> None:
    """Read changed files of one kind; print a line for each, as a process of its own.

    A line: number, s, s of the processor, what was raised, bytes that were written to
    stdout or stderr, MB.
    """
    logging.getLogger("ocufilter").addHandler(logging.NullHandler())
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    kind = next(k for k in kinds(folder) if k.name == name)
    said = os.open(folder / "stderr", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    out = os.fdopen(os.dup(1), "w")
    for stream in (1, 2):  # libraries may write to either
        os.dup2(said, stream)
    place = folder / "read"
    place.mkdir()
    for number in range(first, first + count):
        file_name, content = mutant(kind, number)
        path = place / file_name
        path.write_bytes(content)
        print(f"{number} began", file=out, flush=True)
        raised, before = "", os.fstat(said).st_size
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        try:
            kind.read(path)
            raised = VALID
        except BaseException as error:
            raised = outcome_of(kind, error)
        took_s = time.perf_counter() - start_s
        cpu_s = time.process_time() - start_cpu_s
        sys.stdout.flush()
        path.unlink(missing_ok=True)
        written = os.fstat(said).st_size - before
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        result = [number, took_s, cpu_s, raised, written, peak_mb]
        print(json.dumps(result), file=out, flush=True)


def outcome_of(kind: Kind, error: BaseException) -> str:
    """Return `REFUSED` for a documented error of one line, else what was raised."""
    said = str(error)
    if type(error) not in kind.errors:
        return f"{type(error).__name__}: {said[:100]!r}"
    if not said.isprintable() or len(said) > MAX_CHARACTERS:
        return f"{type(error).__name__} of {len(said)} characters: {said[:100]!r}"
    return REFUSED


class Reads:
    """What came of the reads of one kind."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.times_s: list[float] = []
        self.raised: Counter[str] = Counter()
        self.wrong: list[str] = []
        self.longest_s = self.peak_mb = 0.0

    def run(self, count: int) -> None:
        """Read so many; a process that dies is counted, and another goes on."""
        first = 0
        while first < count:
            with tempfile.TemporaryDirectory(dir=TEMPORARY) as folder:
                first = self._run_process(first, count - first, folder)

    def _run_process(self, first: int, count: int, folder: str) -> int:
        command = [
            *(sys.executable, "-m", "tests.benchmarks.bench_files"),
            *(self.kind.name, str(first), str(count), folder),
        ]
        done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        last = first - 1
        for line in done.stdout.splitlines():
            if line.endswith("began"):
                last = int(line.split()[0])
                continue
            number, took_s, cpu_s, raised, written, peak_mb = json.loads(line)
            self.times_s.append(took_s)
            self.raised[raised.split(":")[0]] += 1
            self.peak_mb = max(self.peak_mb, peak_mb)
            if raised not in (VALID, REFUSED):
                self.wrong.append(f"{number}: {raised}")
            if written:
                self.wrong.append(f"{number}: {written} bytes on stdout or stderr")
            self.longest_s = max(self.longest_s, cpu_s)
            if cpu_s > MAX_READ_S or took_s > WAITING_S:
                self.wrong.append(f"{number}: {cpu_s:.1f} s of {took_s:.1f} s")
        if done.returncode != 0 and last < first:
            said = Path(folder, "stderr")
            reason = said.read_text("utf-8", "replace")[-500:] if said.exists() else ""
            raise RuntimeError(f"{self.kind.name}: no process reads: {reason}")
        if done.returncode != 0:
            self.wrong.append(f"{last}: process ended with {done.returncode}")
        return last + 1 if done.returncode != 0 else first + count

    def rows(self) -> list[Row]:
        """Return them as rows."""
        setting = f"{self.raised[REFUSED]} refused, {self.raised[VALID]} valid"
        errors = {
            "wrong answers": len(self.wrong),
            "longest read, s": self.longest_s,
            "peak memory, MB": self.peak_mb,
        }
        times_ms = 1e3 * np.array(self.times_s or [0.0])
        case = self.kind.name
        return rows_of("reads", case, setting, times_ms, self.peak_mb, errors)


# --- commands --------------------------------------------------------------------


def run_commands(kinds_: list[Kind], count: int, folder: Path) -> list[Row]:
    """Give changed files to `ocufilter`; most are ones that readers refuse."""
    from estimator import InvalidFile

    able = [kind for kind in kinds_ if kind.command is not None]
    chosen: list[tuple[Kind, int]] = []
    number = 1_000_000  # other files than those of the reads
    place = folder / "chosen"
    place.mkdir()
    while len(chosen) < count:
        kind = able[number % len(able)]
        number += 1
        name, content = mutant(kind, number)
        path = place / name
        path.write_bytes(content)
        try:
            kind.read(path)
        except InvalidFile:
            chosen.append((kind, number))
        else:  # valid: some only, where the program then does little
            if len(chosen) % 10 == 0 and kind.name not in ("glTF", "states"):
                chosen.append((kind, number))
        path.unlink()

    def run(one: tuple[Kind, int]) -> tuple[float, float, str]:
        kind, number = one
        own = folder / f"{number}"
        own.mkdir()
        name, content = mutant(kind, number)
        (own / name).write_bytes(content)
        arguments = kind.command(own / name, folder)
        return _run_command(f"{kind.name} {number}", arguments)

    with ThreadPoolExecutor(N_PROCESSES) as pool:
        ran = list(pool.map(run, chosen))
    times_ms = 1e3 * np.array([took_s for took_s, _, _ in ran])
    peak_mb = max(mb for _, mb, _ in ran)
    wrong = [text for _, _, text in ran if text not in ("0", "2")]
    for text in wrong:
        print(f"ocufilter: {text}", file=sys.stderr)
    codes = Counter(text for _, _, text in ran)
    setting = f"{codes['2']} refused, {codes['0']} done"
    errors = {"wrong answers": len(wrong), "peak memory, MB": peak_mb}
    return rows_of("ocufilter", "a process each", setting, times_ms, peak_mb, errors)


def _run_command(label: str, arguments: list[str]) -> tuple[float, float, str]:
    """Return s, MB and the exit code, or what is wrong with it."""
    start_s = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "ocufilter", *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    timer = Timer(COMMAND_S, process.kill)
    timer.start()
    said = process.stderr.read().decode("utf-8", "replace")
    process.stderr.close()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = code = os.waitstatus_to_exitcode(status)
    timer.cancel()
    took_s, peak_mb = time.perf_counter() - start_s, usage.ru_maxrss / 1024.0
    is_fine = code == 0 or (code == 2 and said.count("\n") == 1)
    if not is_fine or "Traceback" in said:
        return took_s, peak_mb, f"{label}: code {code}, stderr {said[-500:]!r}"
    return took_s, peak_mb, str(code)


# --- rows ------------------------------------------------------------------------


def rows_of(
    method: str,
    case: str,
    setting: str,
    times_ms: np.ndarray,
    memory_mb: float,
    errors: dict[str, float],
) -> list[Row]:
    """Return a row for each error."""
    return [
        row_of(
            *("files", method, case, setting, times_ms, name, error, REFERENCE),
            used_mb=memory_mb,
        )
        for name, error in errors.items()
    ]


def measure(run: Run) -> list[Row]:
    """Return the rows of all kinds, of all together, and of the program."""
    n_reads, n_commands = N_READS, N_COMMANDS
    if run.is_quick:
        n_reads, n_commands = QUICK_READS, QUICK_COMMANDS
    with tempfile.TemporaryDirectory(dir=TEMPORARY) as name:
        folder = Path(name)
        every = kinds(folder)
        reads = [Reads(kind) for kind in every[:: 6 if run.is_quick else 1]]
        count = -(-n_reads // len(reads))
        with ThreadPoolExecutor(N_PROCESSES) as pool:
            list(pool.map(lambda one: one.run(count), reads))
        for one in reads:
            for text in one.wrong[:20]:
                print(f"{one.kind.name} {text}", file=sys.stderr)
        rows = [row for one in reads for row in one.rows()]
        times_ms = 1e3 * np.array([t for one in reads for t in one.times_s])
        errors = {
            "wrong answers": sum(len(one.wrong) for one in reads),
            "longest read, s": max(one.longest_s for one in reads),
            "peak memory, MB": max(one.peak_mb for one in reads),
        }
        peak_mb, setting = errors["peak memory, MB"], f"{len(reads)} kinds"
        rows += rows_of("reads", "all", setting, times_ms, peak_mb, errors)
        return rows + run_commands(every, n_commands, folder)


if __name__ == "__main__":  # a process that reads; see `Reads`
    kind_name, first, count, folder = sys.argv[1:]
    read_some(kind_name, int(first), int(count), Path(folder))
