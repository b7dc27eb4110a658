"""Run a benchmark: ``python -m tests.benchmarks NAME [--quick] [--json]``.

In place of NAME, ``results`` measures all of them (`measure_all`), and ``tables``
writes the tables of the documents (`tables`).

A benchmark is a module ``bench_NAME`` with

- a docstring that says what it measures, and which ``--help`` prints;
- ``measure(run)``, which returns rows, or rows and further figures (``details``
  of `harness.publish`);
- ``MINUTES``, the time of a whole run on two idle cores;
- if it needs one, ``options(parser)``, which adds options of its own.  A run with an
  option of its own is not whole.

A row never holds a time without the error it was bought with.
"""

import argparse
import importlib
import runpy
import sys

from tests.benchmarks import measure_all, tables
from tests.benchmarks.harness import ROOT, Run, publish


def main(arguments: list[str]) -> None:
    """Run the benchmark that the first argument names."""
    name, *rest = arguments or [""]
    if name == "results":
        sys.exit(measure_all.main(rest))
    if name == "tables":
        sys.exit(tables.main())
    names = sorted(
        path.stem.removeprefix("bench_")
        for path in (ROOT / "tests/benchmarks").glob("bench_*.py")
    )
    if name not in names:
        sys.exit(f"benchmark: unknown name '{name}'; allowed: {', '.join(names)}")
    module = importlib.import_module(f"tests.benchmarks.bench_{name}")
    if not hasattr(module, "MINUTES"):
        sys.argv = [module.__name__, *rest]
        runpy.run_module(module.__name__, run_name="__main__", alter_sys=True)
        return
    parser = argparse.ArgumentParser(
        prog=f"ocufilter bench {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if hasattr(module, "options"):
        module.options(parser)
    narrowing = vars(parser.parse_args([]))
    parser.add_argument("--quick", action="store_true", help="few cases and repeats")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(rest)
    found = module.measure(Run(is_quick=options.quick, options=options))
    rows, details = found if isinstance(found, tuple) else (found, None)
    publish(
        name,
        rows,
        as_json=options.json,
        is_whole=not options.quick
        and all(getattr(options, key) == value for key, value in narrowing.items()),
        details=details,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
