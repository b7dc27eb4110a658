"""What becomes of the tests that draw, driver by driver."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.gl_witness.drivers import DRIVERS, Driver, environment
from tests.source_tree import ROOT


def say(text: str) -> None:
    """Tell at once: the whole takes half an hour."""
    print(text, flush=True)


COMMAND = (
    *(sys.executable, "-m", "pytest", "-q", "-m", "not gpu"),
    *("-p", "tests.gl_witness.only_gl", "tests/numerical"),
)


def run_all_tests() -> list[dict]:
    """Run all tests that draw on each driver in turn."""
    return [run_tests(driver) for driver in DRIVERS]


def run_tests(driver: Driver) -> dict:
    """Run all tests that draw, and return what became of them."""
    started_s = time.monotonic()
    outcomes = _outcomes(driver)
    told = [outcome["outcome"] for outcome in outcomes.values()]
    row = {
        "driver": str(driver),
        "run": len(told),
        **{name: told.count(name) for name in ("passed", "failed", "skipped")},
        "not_passed": {n: o["why"] for n, o in outcomes.items() if o["why"]},
        "seconds": round(time.monotonic() - started_s),
    }
    say(
        f"{row['driver']:<28} {row['run']} tests, {row['passed']} passed, "
        f"{row['failed']} failed, {row['skipped']} skipped, {row['seconds']} s"
    )
    for name, why in row["not_passed"].items():
        say(f"    {name}: {why.splitlines()[0]}")
    return row


def _outcomes(driver: Driver) -> dict[str, dict[str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder) / "outcomes.json", Path(folder) / "log"
        with log.open("w", encoding="utf-8") as lines:
            subprocess.run(
                COMMAND,
                cwd=ROOT,
                env={**environment(driver), "GL_WITNESS_OUT": str(out)},
                stdout=lines,
                stderr=subprocess.STDOUT,
                check=False,  # what failed stands in the outcomes
            )
        if not out.is_file():
            raise RuntimeError(log.read_text(encoding="utf-8")[-3000:])
        return json.loads(out.read_text(encoding="utf-8"))
