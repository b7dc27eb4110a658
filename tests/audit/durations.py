"""Record the duration of every test case and fixture; a plugin of `tests/conftest.py`.

Set ``OCUFILTER_DURATIONS`` to the path of the JSON file that the session writes.
Times are wall time, and processor time of the worker with its child processes, in
seconds.  Fixtures of a wider scope than one case are listed by themselves: a case
includes its own setup and teardown, but not those of shared fixtures that it happens
to be the first or the last to use.

Cases may take `CASE_BUDGET_S`.  The file and the summary name those over it, in
processor time, that are not marked ``long``.

    python -m tests.audit.durations out/durations/*.json    add up the files of suites
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest

CASE_BUDGET_S = 0.2
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def _child_seconds(process_id: int) -> float:
    """Return the processor time of a process's descendants, ended ones included."""
    total_s, waiting = 0.0, [process_id]
    while waiting:
        current = waiting.pop()
        try:
            text = Path(f"/proc/{current}/stat").read_text(encoding="utf-8")
            threads = os.listdir(f"/proc/{current}/task")
        except (FileNotFoundError, ProcessLookupError):
            continue  # ended meanwhile: its parent's next reading includes its time
        for thread in threads:
            children = Path(f"/proc/{current}/task/{thread}/children")
            # the process outlives a thread that ended meanwhile
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                waiting += map(int, children.read_text(encoding="utf-8").split())
        fields = text.rpartition(")")[2].split()  # field 3 onward; the name has spaces
        own, ended = fields[11:13], fields[13:15]
        counted = ended if current == process_id else own + ended
        total_s += sum(map(int, counted)) / TICKS_PER_S
    return total_s


def _now() -> tuple[float, float]:
    """Return wall time and the processor time of this process and its children."""
    return time.perf_counter(), time.process_time() + _child_seconds(os.getpid())


class Durations:
    """Measure cases and fixtures where they run; write the file in the controller."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cases: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        self.fixtures: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0])
        self.outcomes: dict[str, str] = {}
        self.long: set[str] = set()
        self.started = _now()
        self.shared: list[tuple[str, float, float]] = []  # in the phase that runs

    # --- in the worker ------------------------------------------------------------

    def _add(self, name: str, begun: tuple[float, float]) -> None:
        wall_s, processor_s = (b - a for a, b in zip(begun, _now(), strict=True))
        self.shared.append((name, wall_s, processor_s))

    @contextlib.contextmanager
    def apart(self):
        """Count as a shared fixture: the start of a service that several tests use."""
        begun = _now()
        try:
            yield
        finally:
            self._add("tests/end_to_end::services of the pool", begun)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        """Time a shared fixture, and its teardown by its first and last finalizers."""
        if fixturedef.scope == "function":
            return (yield)
        name = f"{fixturedef.baseid or 'tests'}::{fixturedef.argname}"
        begun, torn_down = _now(), []
        fixturedef.addfinalizer(lambda: self._add(name, torn_down.pop()))
        value = yield
        self._add(name, begun)
        fixturedef.addfinalizer(lambda: torn_down.append(_now()))
        return value

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        """Name the test for processes that it starts; their coverage records it."""
        os.environ.pop("OCUFILTER_DURATIONS", None)  # sessions that a test starts
        os.environ["OCUFILTER_TEST"] = item.nodeid
        if "OCUFILTER_COVERAGE" in os.environ:
            import coverage

            coverage.Coverage.current().switch_context(item.nodeid)
        self.begun = _now()
        self.shared = []
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item):
        """Attach what the phase took, with all that ran since the last one."""
        report = yield
        now = _now()
        taken = [b - a for a, b in zip(self.begun, now, strict=True)]
        for _, *spent in self.shared:
            taken = [a - b for a, b in zip(taken, spent, strict=True)]
        report.taken_s, report.shared_s = taken, self.shared
        report.is_long = item.get_closest_marker("long") is not None
        self.begun, self.shared = now, []
        return report

    # --- in the controller --------------------------------------------------------

    def pytest_runtest_logreport(self, report):
        """Collect a phase; xdist passes the attributes on."""
        if not hasattr(report, "taken_s"):
            return  # a worker that crashed
        if report.is_long:
            self.long.add(report.nodeid)
        case = self.cases[report.nodeid]
        for index, spent_s in enumerate(report.taken_s):
            case[index] += spent_s
        for name, wall_s, processor_s in report.shared_s:
            entry = self.fixtures[name]
            entry[0], entry[1] = entry[0] + wall_s, entry[1] + processor_s
            entry[2] += 1
        if report.outcome != "passed" or report.when == "call":
            self.outcomes[report.nodeid] = report.outcome

    def over_budget_unmarked(self) -> dict[str, list[float]]:
        """Return the times of cases over the budget without the mark ``long``.

        In processor time, which other programs of the machine disturb less.
        """
        return _sorted(
            {
                name: taken
                for name, taken in self.cases.items()
                if taken[1] > CASE_BUDGET_S and name not in self.long
            },
            index=1,
        )

    def pytest_terminal_summary(self, terminalreporter):
        """Write the file and print what took longest."""
        if not self.cases:
            return
        files: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0])
        for name, (wall_s, processor_s) in self.cases.items():
            entry = files[name.partition("::")[0]]
            entry[0], entry[1] = entry[0] + wall_s, entry[1] + processor_s
            entry[2] += 1
        wall_s, processor_s = (b - a for a, b in zip(self.started, _now(), strict=True))
        sums = [
            sum(t[i] for t in (*files.values(), *self.fixtures.values()))
            for i in (0, 1)
        ]
        over = [name for name, taken in self.cases.items() if taken[0] > CASE_BUDGET_S]
        unmarked = self.over_budget_unmarked()
        document = {
            "session_s": wall_s,
            "worker_s": sums[0],
            "processor_s": sums[1],
            "over_budget_count": len(over),
            "over_budget_unmarked": unmarked,
            "long_count": len(self.long),
            "files": _sorted(files),
            "shared_fixtures": _sorted(self.fixtures),
            "cases": _sorted(self.cases),
            "outcomes": {k: v for k, v in self.outcomes.items() if v != "passed"},
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(document, indent=0) + "\n", encoding="utf-8")
        terminalreporter.section("durations")
        terminalreporter.line(
            f"{sums[0]:.0f} worker seconds ({sums[1]:.0f} of processors), "
            f"{len(over)} of {len(self.cases)} cases over {CASE_BUDGET_S} s; "
            f"see {self.path}"
        )
        terminalreporter.line(
            f"{len(self.long)} cases are marked long; {len(unmarked)} others take more "
            f"than {CASE_BUDGET_S} s of processors"
        )
        for title, entries in (("files", files), ("shared fixtures", self.fixtures)):
            terminalreporter.line(f"slowest {title}:")
            for name, (spent_s, _, count) in list(_sorted(entries).items())[:10]:
                terminalreporter.line(f"  {spent_s:7.1f} s {count:5d}  {name}")


def _sorted(entries, index=0):
    """Return entries from the slowest to the fastest, rounded to 0.1 ms."""
    ordered = sorted(entries.items(), key=lambda entry: -entry[1][index])
    return {name: [round(number, 4) for number in taken] for name, taken in ordered}


def main(paths: list[str]) -> None:
    """Print what the suites of several files took, and their sum."""
    print("suite             session s  worker s  processor s  cases  over 0.2 s")
    sums = [0.0, 0.0, 0.0, 0, 0]
    for path in map(Path, paths):
        document = json.loads(path.read_text(encoding="utf-8"))
        row = [document[name] for name in ("session_s", "worker_s", "processor_s")]
        row += [len(document["cases"]), document["over_budget_count"]]
        sums = [a + b for a, b in zip(sums, row, strict=True)]
        print(_row(path.stem, row))
    print(_row("all suites", sums))


def _row(name: str, numbers: list[float]) -> str:
    session_s, worker_s, processor_s, cases, over = numbers
    times = f"{session_s:9.0f} {worker_s:9.0f} {processor_s:12.0f}"
    return f"{name:17} {times} {cases:6d} {over:11d}"


if __name__ == "__main__":
    main(sys.argv[1:])
