"""Measure every benchmark at one commit.

    python -m tests.benchmarks results [NAMES] [--plan] [--no-wait] [--out DIR]

Runs the named benchmarks, or all, one after the other, and writes results/NAME.json and
pictures, and then the tables of the documents.  Every file records the commit, which is
the last that changed anything but results and documents, and the minutes of the run.

- A tree with uncommitted changes of other files is refused.
- Benchmarks that were measured at this commit are skipped, so that a run that was ended
  continues where it was.
- A benchmark that fails leaves its former result, and does not stop the others.  The
  exit status is 1, and out/results/NAME.log has what it printed.
- ``--plan`` prints what would be measured, how long it takes, and what is missing.
- Each waits up to a minute until other programs pause; ``--no-wait`` does not.
- ``--out`` writes to another folder.  It also measures changed trees, whose commit ends
  in "+", and then skips nothing.  What lacks packages is left out and is no failure.
"""

import argparse
import ast
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from filter_service.progress import Progress, Task
from tests.benchmarks import tables
from tests.benchmarks.harness import KEPT_RESULTS, OUT, RESULTS, ROOT, git

FOLDER = Path(__file__).parent
LOGS = OUT / "results"
NOT_MEASURED = (
    ":(exclude)tests/benchmarks/results",
    ":(exclude)tests/benchmarks/tables.toml",
    ":(exclude,glob)**/*.md",
)
"""What no benchmark depends on: results, and documents with the tables of results."""

GUESS_MINUTES = 3.0
GOAL_MINUTES = 150.0
N_LARGEST = 5
QUIET_CORES = 0.5
QUIET_WAIT_S = 60.0
POLL_S = 0.5
HEADSET_ROOT = Path(os.environ.get("HEADSET_ROOT") or ROOT / ".headset")


@dataclass(frozen=True)
class Need:
    """What a benchmark needs in addition to the packages of the tests."""

    what: str
    install: str
    is_met: Callable[[], bool]


def _has(*modules: str) -> bool:
    return all(importlib.util.find_spec(name) is not None for name in modules)


BROWSER = Need(
    "the page's packages and a browser",
    "make setup-web",
    lambda: shutil.which("chromium") is not None and _has("playwright", "nicegui"),
)
CHROOT = Need(
    "the chroot of the headset",
    "sh tests/headset/setup_root.sh",
    lambda: (HEADSET_ROOT / "bin/sh").exists(),
)
PEERS = Need(
    "the alternatives",
    "make setup-peers",
    lambda: (ROOT / ".peers/bin/python").exists(),
)
TORCH = Need("torch", "make setup-training", lambda: _has("torch"))
PATH_TRACER = Need(
    "a path tracer",
    "make setup-witness",
    lambda: (ROOT / ".witness/bin/python").exists(),
)
NEEDS = {
    "layer": CHROOT,
    "ml": TORCH,
    "peers": PEERS,
    "web": BROWSER,
    "witness": PATH_TRACER,
}
IN_CHROOT = ("layer",)
"""Benchmarks that run in the chroot, where the checkout is read-only: their result is
the JSON object that they print."""


@dataclass(frozen=True)
class Benchmark:
    """A benchmark, how to run it, and how long that takes."""

    name: str
    command: tuple[str, ...]
    minutes: float
    is_guess: bool

    @property
    def missing(self) -> Need | None:
        """Return the need that this machine does not meet."""
        need = NEEDS.get(self.name)
        return None if need is None or need.is_met() else need


def _in_module(path: Path) -> tuple[float | None, bool]:
    """Return MINUTES of a module, and whether it has a function ``measure``.

    The module is read but not imported, because its packages may be missing.
    """
    minutes, has_measure = None, False
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            has_measure |= node.name == "measure"
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "MINUTES":
            minutes = float(ast.literal_eval(node.value))
    return minutes, has_measure


def _result(folder: Path, name: str) -> dict:
    path = folder / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def benchmarks() -> dict[str, Benchmark]:
    """Return all benchmarks but those of `KEPT_RESULTS`, by name."""
    found = {}
    for path in sorted(FOLDER.glob("bench_*.py")):
        name = path.stem.removeprefix("bench_")
        if name in KEPT_RESULTS:
            continue
        expected, has_measure = _in_module(path)
        # The last run tells the time better than the constant of the module.
        minutes = _result(RESULTS, name).get("minutes", expected)
        command: tuple[str, ...] = (sys.executable,)
        if name in IN_CHROOT:
            command = ("sh", "tests/headset/run_in_root.sh", "env")
            command += ("OCUFILTER_COMMIT={commit}", "python")
        command += ("-m", "tests.benchmarks", name)
        command += ("--json",) * (name in IN_CHROOT and has_measure)
        is_guess = minutes is None
        minutes = GUESS_MINUTES if minutes is None else float(minutes)
        found[name] = Benchmark(name, command, minutes, is_guess)
    return found


def changed_files() -> list[str]:
    """Return the files with uncommitted changes, without results and documents."""
    lines = git("status", "--porcelain", "--", ".", *NOT_MEASURED).splitlines()
    return [line[3:] for line in lines]


def code_commit() -> str:
    """Return the short hash of the last commit that changed what is measured."""
    return git("log", "-1", "--abbrev=8", "--format=%h", "--", ".", *NOT_MEASURED)


def _busy_cores() -> float:
    """Return how many cores worked within a second."""

    def busy_s() -> float:
        words = Path("/proc/stat").read_text(encoding="utf-8").split("\n")[0].split()
        user, nice, system, *rest = (int(word) for word in words[1:])
        return (user + nice + system + sum(rest[2:5])) / os.sysconf("SC_CLK_TCK")

    before_s = busy_s()
    time.sleep(1.0)
    return busy_s() - before_s


def wait_until_quiet(wait_s: float) -> float:
    """Wait until other programs pause, or for some time; return the busy cores."""
    until_s = time.monotonic() + wait_s
    while (busy := _busy_cores()) > QUIET_CORES and time.monotonic() < until_s:
        time.sleep(2.0)
    return busy


class Failed(Exception):
    """A benchmark failed or took too long."""


def _ended(process: subprocess.Popen) -> None:
    """End a program with the processes that it started."""
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(10.0)
    except ProcessLookupError:
        return
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def run_one(
    bench: Benchmark, folder: Path, commit: str, show: Callable[[float], None]
) -> float:
    """Run a benchmark, whose files replace those in a folder; return its minutes.

    Raises
    ------
    Failed
        If it fails, takes three times as long as planned and ten minutes more, or
        writes no result.
    """
    log_path = LOGS / f"{bench.name}.log"
    limit_minutes = 10.0 + 3.0 * bench.minutes
    start_s = time.monotonic()
    is_printed = bench.name in IN_CHROOT
    with tempfile.TemporaryDirectory(dir=LOGS) as out_name, log_path.open("wb") as log:
        out = Path(out_name)
        result = out / f"{bench.name}.json"
        words = [word.format(commit=commit) for word in bench.command]
        told = {"OCUFILTER_RESULTS": out_name, "OCUFILTER_COMMIT": commit}
        with (result if is_printed else Path(os.devnull)).open("wb") as printed:
            process = subprocess.Popen(
                words,
                cwd=ROOT,
                env={**os.environ, **told},
                stdin=subprocess.DEVNULL,
                stdout=printed if is_printed else log,
                stderr=log,
                start_new_session=True,
            )
            try:
                while process.poll() is None:
                    minutes = (time.monotonic() - start_s) / 60.0
                    if minutes > limit_minutes:
                        raise Failed(f"ended after {minutes:.0f} min")
                    show(min(minutes, bench.minutes))
                    time.sleep(POLL_S)
            finally:
                _ended(process)
        minutes = (time.monotonic() - start_s) / 60.0
        if process.returncode != 0:
            raise Failed(f"exit status {process.returncode}")
        try:
            content = _result(out, bench.name)
        except ValueError:
            raise Failed("its result is not JSON") from None
        if not content:
            raise Failed("it wrote no result")
        content = {"commit": commit, **content, "minutes": round(minutes, 2)}
        result.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        # Results are moved last: one without its pictures is measured again.
        for path in sorted(out.iterdir(), key=lambda path: path.suffix == ".json"):
            shutil.move(path, folder / path.name)
        return minutes


def print_plan(commit: str, chosen: list[Benchmark], skipped: list[str]) -> None:
    """Print what is measured, how long it takes, and what is missing."""
    total = sum(bench.minutes for bench in chosen)
    print(f"commit {commit}: {len(chosen)} benchmarks, about {total:.0f} min")
    for bench in chosen:
        note = " (a guess: the module has no MINUTES)" if bench.is_guess else ""
        print(f"  {bench.name:<16}{bench.minutes:>6.1f} min{note}")
    largest = sorted(chosen, key=lambda bench: -bench.minutes)[:N_LARGEST]
    if len(chosen) > N_LARGEST:
        names = ", ".join(f"{bench.name} {bench.minutes:.0f}" for bench in largest)
        print(f"largest, min: {names}")
    if total > GOAL_MINUTES:
        print(f"more than the goal of {GOAL_MINUTES:.0f} min")
    if skipped:
        print(f"measured at this commit: {', '.join(skipped)}")
    for bench in chosen:
        if (need := bench.missing) is not None:
            print(f"missing: {bench.name} requires {need.what}: {need.install}")


def _measured(
    chosen: list[Benchmark], options: argparse.Namespace, state: tuple, task: Task
) -> dict[str, str]:
    """Run benchmarks; return the errors of those that failed."""
    commit = state[0] + "+" * bool(state[1])
    wait_s = 0.0 if options.no_wait else QUIET_WAIT_S
    errors = {}
    done = 0.0
    total = sum(bench.minutes for bench in chosen)
    for k, bench in enumerate(chosen):
        stage = f"{bench.name}, {k + 1} of {len(chosen)}, {total - done:.0f} min left"
        task.update(done, stage)
        if (need := bench.missing) is not None:
            errors[bench.name] = f"requires {need.what}: {need.install}"
        else:
            busy = wait_until_quiet(wait_s)
            if busy > QUIET_CORES:
                print(f"{bench.name}: other programs use {busy:.1f} cores")
            before = done
            try:
                minutes = run_one(
                    bench, options.out, commit, lambda m, b=before: task.update(b + m)
                )
                print(f"{bench.name}: {minutes:.1f} min", flush=True)
            except Failed as error:
                log = (LOGS / f"{bench.name}.log").relative_to(ROOT)
                errors[bench.name] = f"{error}; see {log}"
        done += bench.minutes
        if (code_commit(), changed_files()) != state:
            names = ", ".join(changed_files()) or "another commit"
            sys.exit(f"results: the tree changed during the run: {names}")
    task.update(done, "")
    return errors


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks results",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAMES")
    parser.add_argument("--plan", action="store_true", help="only print the plan")
    parser.add_argument("--no-wait", action="store_true", help="measure at any load")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="DIR")
    options = parser.parse_args(arguments)
    known = benchmarks()
    for name in options.names:
        if name in KEPT_RESULTS:
            parser.error(f"{name} keeps the commit at which it was measured")
        if name not in known:
            parser.error(f"unknown benchmark '{name}'; allowed: {', '.join(known)}")
    commit, changed = code_commit(), changed_files()
    if not commit:
        sys.exit("results: this is not a git checkout, so results have no commit")
    is_trial = options.out.resolve() != RESULTS
    if changed and not (is_trial or options.plan):
        names = "\n  ".join(changed)
        sys.exit(f"results: commit these changes first:\n  {names}")
    state, commit = (commit, changed), commit + "+" * bool(changed)
    asked = [known[name] for name in options.names or known]
    skipped = [
        bench.name
        for bench in asked
        if not changed and _result(options.out, bench.name).get("commit") == commit
    ]
    chosen = [bench for bench in asked if bench.name not in skipped]
    print_plan(commit, chosen, skipped)
    if is_trial:
        chosen = [bench for bench in chosen if bench.missing is None]
    if options.plan or not chosen:
        return 0
    for folder in (options.out, LOGS):
        folder.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    total = sum(bench.minutes for bench in chosen)
    with Progress("results", interval_s=60.0) as progress:
        task = progress.task("measuring", total=total, unit="min")
        errors = _measured(chosen, options, state, task)
    for name, error in errors.items():
        print(f"failed: {name}: {error}")
    print(f"{len(chosen) - len(errors)} results in {options.out}")
    is_incomplete = bool(errors) or (not is_trial and tables.main() != 0)
    return 1 if is_incomplete else 0
