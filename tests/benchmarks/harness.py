"""Shared by the benchmarks: the machine, the commit, timing, and rows of results.

A row never holds a time without the error it was bought with.
"""

import json
import os
import platform
import resource
import shutil
import subprocess
import time
from argparse import Namespace
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
RESULTS = Path(__file__).parent / "results"
"""Committed results.  Only ``make results`` writes there: see `written_path`."""

OUT = ROOT / "out"

KEPT_RESULTS = ("gl_witness", "gpu", "headset_monado", "render_h100")
"""Results of hardware and of a headset's runtime: they keep the commit at which they
were measured, because ``make results`` cannot repeat them on any machine."""

WARM_UPS = 2


@dataclass(frozen=True)
class Run:
    """How a benchmark runs: ``options`` holds those that it adds itself."""

    is_quick: bool = False
    options: Namespace = field(default_factory=Namespace)


@dataclass(frozen=True)
class Row:
    """One measurement; ``error_name`` says in which measure ``error`` is."""

    bench: str
    method: str
    case: str
    setting: str
    n: int
    median_ms: float
    p95_ms: float
    memory_mb: float
    error_name: str
    error: float
    reference: str


def nvidia_smi(query: str) -> str:
    """Return what nvidia-smi tells of a GPU, by the names of its ``--query-gpu``."""
    if shutil.which("nvidia-smi") is None:
        return "not told"
    told = subprocess.run(
        ["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"],
        capture_output=True,
        text=True,
        check=False,
    )
    return told.stdout.strip() or "not told"


def machine_info() -> dict:
    """Processor, cores in use and versions of the numerical libraries."""
    name = platform.processor()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        lines = cpu_info.read_text(encoding="utf-8").splitlines()
        names = [
            line.split(":", 1)[1].strip() for line in lines if "model name" in line
        ]
        name = names[0] if names else name
    return {
        "cpu": name,
        "n_cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        **{lib: version(lib) for lib in ("numpy", "scipy")},
    }


def git(*arguments: str) -> str:
    """Return what git prints about the checkout; empty if it fails or is missing."""
    if shutil.which("git") is None:
        return ""
    answer = subprocess.run(
        ("git", *arguments), cwd=ROOT, capture_output=True, text=True, check=False
    )
    return answer.stdout.strip("\n") if answer.returncode == 0 else ""


def commit_id() -> str:
    """Short hash of the checkout, with "+" where files differ from it.

    Of a copy without its history OCUFILTER_COMMIT tells.
    """
    told = os.environ.get("OCUFILTER_COMMIT")
    if told:
        return told
    changed = git("status", "--porcelain", "--untracked-files=no")
    head = git("rev-parse", "--short", "HEAD")
    return (head or "none") + ("+" if changed else "")


def time_calls(
    function, *, repeats: int, per_call: int = 1, clock=time.perf_counter
) -> tuple[float, float]:
    """Median and 95th percentile of a call in ms, after warm-ups.

    ``per_call``: how many units of work one call does; times are per unit.
    """
    for _ in range(WARM_UPS):
        function()
    times_ms = []
    for _ in range(repeats):
        start = clock()
        function()
        times_ms.append((clock() - start) * 1000.0 / per_call)
    return float(np.median(times_ms)), float(np.percentile(times_ms, 95))


def memory_mb() -> float:
    """Largest memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def report(rows: list[Row], *, machine: dict | None = None) -> dict:
    """What ``ocufilter bench`` prints: machine, commit and rows."""
    return {
        "machine": machine or machine_info(),
        "commit": commit_id(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "rows": [asdict(row) for row in rows],
    }


def written_path(file_name: str) -> Path:
    """Return where a whole run writes a file: in out/, or where `measure_all` says."""
    folder = Path(os.environ.get("OCUFILTER_RESULTS") or OUT)
    folder.mkdir(parents=True, exist_ok=True)
    return folder / file_name


def write_report(name: str, content: dict) -> Path:
    """Write the report NAME.json of a whole run; see `written_path`."""
    path = written_path(f"{name}.json")
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


class KeptRows:
    """File out/NAME_rows.jsonl of the rows of a run that may be ended early."""

    def __init__(self, name: str):
        OUT.mkdir(exist_ok=True)
        self._path = OUT / f"{name}_rows.jsonl"
        self._path.write_text("", encoding="utf-8")

    def add(self, row: Row) -> None:
        """Add a row."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"row": asdict(row)}) + "\n")


def publish(
    name: str,
    rows: list[Row],
    *,
    as_json: bool,
    is_whole: bool,
    details: dict[str, list[dict]] | None = None,
) -> None:
    """Print rows as JSON, or print them as a table and write those of a whole run.

    ``details`` are lists of other figures, which are printed below the table.
    """
    content = report(rows) | (details or {})
    if as_json:
        print(json.dumps(content))
        return
    print_rows(rows)
    for line in (line for lines in (details or {}).values() for line in lines):
        print("  ".join(f"{name}={value}" for name, value in line.items()))
    if is_whole:
        print(f"wrote {write_report(name, content)}")


def print_rows(rows: list[Row]) -> None:
    """Readable table of rows."""
    header = ("method", "case", "setting", "n", "ms", "p95", "error", "value")
    print("{:<18} {:<14} {:<26}{:>5}{:>9}{:>9}  {:<14}{:>10}".format(*header))
    for row in rows:
        print(
            f"{row.method:<18} {row.case:<14} {row.setting:<26}{row.n:>5}"
            f"{row.median_ms:>9.3f}{row.p95_ms:>9.3f}  {row.error_name:<14}"
            f"{row.error:>10.4g}"
        )
