"""Thirty deliberate faults: which of them do the tests catch?

    python -m tests.audit.faults draw COVERAGE     write tests/audit/faults.json
    python -m tests.audit.faults run COVERAGE      run the tests of each fault's line

``COVERAGE`` is the folder that ``tests/audit/coverage.sh`` wrote.  `draw` selects lines
at random, with a fixed seed, among those that tests execute inside functions, and
changes one operator, number, condition or statement in each.  `run` applies each fault
to a copy of the checkout and runs the tests that execute its line until one fails that
passes without the fault.
Compiled functions are not traced, and therefore not drawn.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.source_tree import ROOT

SEED = 20261129
OFTEN = "not clock and not slow and not gpu and (brief or not (gl or clients or tools))"
FAULTS = Path(__file__).with_name("faults.json")
COPY = ROOT / "out" / "faults"
COUNTS = {"estimator": 6, "planning": 6, "rendering": 6, "wire": 6, "service": 6}
AREAS = {
    "estimator": ("estimator/",),
    "planning": ("filter_service/planning/", "filter_service/psfs/"),
    "rendering": ("filter_service/rendering/",),
    "wire": ("filter_service/wire/", "filter_service/messages.py"),
    "service": ("filter_service/service/",),
}
LIMIT_S = 300.0
"""Time after which tests count as without an end; the longest take 160 s."""

USES_SHARED_SERVICE = re.compile(
    r"\b(shared|real|brief|small)_service\b|\buse_service\b|^def test_.*\bclient\b",
    re.M,
)
"""Such a test may use a service that another one has started, to which coverage
attributes its lines."""

SWAPS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: (" is ", " is not "),
    ast.IsNot: (" is not ", " is "),
    ast.And: (" and ", " or "),
    ast.Or: (" or ", " and "),
}


def _replaced_between(
    source: list[str], left: ast.AST, right: ast.AST, old: str, new: str
) -> str | None:
    """Return the line with the operator between two nodes of one line replaced."""
    row = left.end_lineno - 1
    if right.lineno - 1 != row:
        return None
    line = source[row].encode()
    middle = line[left.end_col_offset : right.col_offset].decode()
    if middle.count(old) != 1:
        return None
    head, tail = line[: left.end_col_offset], line[right.col_offset :]
    return head.decode() + middle.replace(old, new) + tail.decode()


def _changes(source: list[str], node: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line number and the changed line of each fault in one node."""
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
        new = _replaced_between(source, node.left, node.right, *SWAPS[type(node.op)])
        if new:
            yield node.left.end_lineno, new
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        swap = SWAPS[type(node.ops[0])]
        new = _replaced_between(source, node.left, node.comparators[0], *swap)
        if new:
            yield node.left.end_lineno, new
    elif isinstance(node, ast.BoolOp):
        new = _replaced_between(source, *node.values[:2], *SWAPS[type(node.op)])
        if new:
            yield node.values[0].end_lineno, new
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        if node.lineno == node.end_lineno:
            line = source[node.lineno - 1].encode()
            if isinstance(node.value, bool):
                new = repr(not node.value)
            elif isinstance(node.value, int):
                new = repr(node.value + 1)
            else:
                new = repr(1.1 * node.value or 0.1)
            head, tail = line[: node.col_offset], line[node.end_col_offset :]
            yield node.lineno, (head + new.encode() + tail).decode()
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        if node.lineno == node.end_lineno:
            line = source[node.lineno - 1].encode()
            yield node.lineno, line[: node.col_offset].decode() + "pass"


def _skipped(node: ast.AST) -> bool:
    """Whether a statement has no behavior to test: a message, an annotation."""
    return isinstance(node, ast.Raise | ast.Assert | ast.AnnAssign | ast.ClassDef)


def _nodes(function: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a function's body without defaults, messages and loggers."""
    pending = list(function.body)
    while pending:
        node = pending.pop()
        if _skipped(node):
            continue
        yield node
        pending += ast.iter_child_nodes(node)


def candidates(path: Path, lines: set[int]) -> list[dict]:
    """Return the possible faults on executed lines of a file's functions."""
    text = path.read_text(encoding="utf-8")
    source, found = text.splitlines(), []
    for function in ast.walk(ast.parse(text)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for node in _nodes(function):
            for number, changed in _changes(source, node):
                if number in lines and changed != source[number - 1]:
                    fault = {"line": source[number - 1], "fault": changed}
                    found.append({**fault, "number": number, "in": function.name})
    return found


def read_coverage(folder: Path):
    """Return coverage's data of a run, combined."""
    from coverage import CoverageData

    data = CoverageData(str(folder / "combined"))
    data.read()
    return data


def _tests_by_line(data, path: Path) -> dict[int, list[str]]:
    """Return the tests that execute each line of a file.

    The name "" stands for processes that several tests use.
    """
    found = data.contexts_by_lineno(str(path))
    return {
        number: sorted({name for context in names for name in context.split("|")})
        for number, names in found.items()
    }


def _measured_root(data) -> str:
    """Return the root of the checkout in which coverage was measured."""
    end = "filter_service/settings.py"
    path = next(path for path in data.measured_files() if path.endswith(end))
    return path.removesuffix(end)


def draw(folder: Path) -> None:
    """Select the faults and write them to `FAULTS`."""
    data = read_coverage(folder)
    root = _measured_root(data)
    generator, chosen = random.Random(SEED), []
    for area, prefixes in AREAS.items():
        possible = []
        for path in sorted(data.measured_files()):
            name = path.removeprefix(root)
            if not name.startswith(prefixes):
                continue
            tests = _tests_by_line(data, path)
            lines = {number for number, names in tests.items() if any(names)}
            for fault in candidates(ROOT / name, lines):
                possible.append({"area": area, "file": name, **fault})
        files: set[str] = set()
        generator.shuffle(possible)
        for fault in possible:
            if fault["file"] in files or len(files) == COUNTS[area]:
                continue
            files.add(fault["file"])
            chosen.append(fault)
        print(f"{area}: {len(possible)} possible faults")
    FAULTS.write_text(json.dumps(chosen, indent=1) + "\n", encoding="utf-8")


def _copy_checkout() -> None:
    """Copy tracked files and compiled libraries to `COPY`; link the environment."""
    shutil.rmtree(COPY, ignore_errors=True)
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    built = [p for p in ROOT.glob("*/*/*.so") if ".venv" not in p.parts]
    tracked = [ROOT / name for name in names.decode().split("\0") if name]
    for path in [*tracked, *built]:
        if not path.is_file():
            continue
        copy = COPY / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)
    (COPY / ".venv").symlink_to(ROOT / ".venv")


def _selection(tests: list[str]) -> list[str]:
    """Return the tests to run: whole files where services are shared by tests."""
    files = {test.partition("::")[0] for test in tests}
    shared = {name for name in files if name.startswith("tests/end_to_end/")}
    users = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests" / "end_to_end").glob("test_*.py")
        if USES_SHARED_SERVICE.search(path.read_text(encoding="utf-8"))
    }
    if shared & users or "" in tests:
        shared |= users
    shared.discard("")
    alone = [t for t in tests if t and t.partition("::")[0] not in shared]
    return [*alone, *sorted(shared)]


def run(folder: Path, marker: str, numbers: list[int]) -> None:
    """Apply each fault to a copy, run its tests and print whether they catch it."""
    data = read_coverage(folder)
    root = _measured_root(data)
    faults = json.loads(FAULTS.read_text(encoding="utf-8"))
    if numbers:
        faults = [faults[number - 1] for number in numbers]
    _copy_checkout()
    results = []
    for fault in faults:
        path = COPY / fault["file"]
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        number = _position(lines, fault)
        tests = _tests_by_line(data, Path(root + fault["file"])).get(number, [])
        lines[number - 1] = fault["fault"]
        begun, by, excluded = time.perf_counter(), None, []
        while tests and by is None:
            path.write_text("\n".join(lines) + "\n", encoding="utf-8")
            by = _failing(_selection(tests), marker, excluded)
            path.write_text(text, encoding="utf-8")
            if by is None or not by.startswith("tests/") or not _failing([by], ""):
                break
            excluded.append(by)  # it fails without the fault, too
            by = None
        spent_s = time.perf_counter() - begun
        results.append({**fault, "tests": len(tests), "caught_by": by})
        outcome = f"{'caught' if by else 'MISSED':7} {spent_s:6.1f} s"
        place = f"{fault['file']}:{number}  {fault['fault'].strip()}"
        print(f"{outcome} {len(tests):5d} tests  {place}  {by or ''}", flush=True)
    print(f"{sum(bool(r['caught_by']) for r in results)} of {len(results)} caught")
    out = ROOT / "out" / "faults.json"
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def _position(lines: list[str], fault: dict) -> int:
    """Return where a fault's line is now: the occurrence nearest to the drawn one."""
    found = [n for n, line in enumerate(lines, 1) if line == fault["line"]]
    if not found:
        raise SystemExit(f"{fault['file']} has no line {fault['line']!r} any more")
    return min(found, key=lambda n: abs(n - fault["number"]))


def _failing(tests: list[str], marker: str, excluded: Sequence[str] = ()) -> str | None:
    """Return a test of a list that fails in the copy, "collection" or "no end"."""
    listed = COPY / "tests.txt"
    listed.write_text("\n".join(tests), encoding="utf-8")
    command = [COPY / ".venv/bin/python", "-m", "pytest", "-x", "-q", "-n", "2"]
    command += [
        "-m",
        marker,
        f"@{listed}",
        *(f"--deselect={name}" for name in excluded),
    ]
    environment = {**os.environ, "PYTHONPATH": str(COPY)}
    process = subprocess.Popen(
        command,
        cwd=COPY,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        output, errors = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return "no end"
    if process.returncode in (0, 5):
        return None
    if process.returncode not in (1, 2):
        sys.stderr.write(output[-2000:] + errors[-2000:])
    found = re.search(r"^(?:FAILED|ERROR) (tests/.*?)(?: - .*)?$", output, re.M)
    return found[1] if found else "collection"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("action", choices=["draw", "run"])
    parser.add_argument("coverage", type=Path, help="folder of coverage.sh")
    parser.add_argument("-m", dest="marker", default=OFTEN)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of faults")
    given = parser.parse_args()
    if given.action == "draw":
        draw(given.coverage)
    else:
        run(given.coverage, given.marker, given.only)


if __name__ == "__main__":
    main()
