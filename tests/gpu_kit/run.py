"""Sets up a machine without a network, and measures all that the kit measures there.

    sh run.sh [--quick] [--out DIR] [--steps NAME ...] [--budget-s N] [--loaders kit]

Steps run in order of worth within 8 minutes; report.md is written anew after each, so
that what ends the run early takes no more than the step that it meets.
"""

import argparse
import json
import subprocess
import sys
import tarfile
import time
from pathlib import Path

from tests.gpu_kit import environment
from tests.gpu_kit.goals import read_goals
from tests.gpu_kit.report import report_text
from tests.gpu_kit.runner import (
    DONE,
    FAILED,
    LEFT_OUT,
    NOT_BEGUN,
    TOO_LONG,
    Budget,
    Outcome,
    kept_rows,
    last_lines,
    printed_json,
    run_program,
)
from tests.gpu_kit.steps import Step, all_steps

TREE = Path(__file__).parents[2]
BUDGET_S, QUICK_BUDGET_S = 480.0, 900.0
QUICK_LIMIT_S = 300.0


def say(text: str) -> None:
    """Tell how far it is."""
    print(f"gpu-kit: {text}", file=sys.stderr, flush=True)


class Run:
    """One run of the kit: its steps, one after the other, and their files.

    Parameters
    ----------
    out : Path
        Folder of the results; of steps that do not run what is there stays.
    commit : str
    is_quick : bool
    budget : Budget
    """

    def __init__(self, out: Path, *, commit: str, is_quick: bool, budget: Budget):
        self.out, self.commit, self.is_quick = out, commit, is_quick
        self.budget = budget
        self.outcomes: list[Outcome] = []
        self.hardware: dict = {}
        (out / "logs").mkdir(parents=True, exist_ok=True)

    def set_up(self, kit: Path, *, loaders: str) -> tuple[Path, dict[str, str]]:
        """Make the environment; its Python, and the variables of the steps.

        Raises
        ------
        environment.SetUpFailed
            The machine lacks something.
        """
        start_s, notes = time.monotonic(), []
        python = environment.make_environment(
            kit / "unpacked" / "venv", sorted((kit / "wheels").glob("*.whl"))
        )
        missing = environment.missing_modules(python)
        if missing:
            notes.append(f"not here, nor carried: {', '.join(missing)}")
        if {"numpy", "scipy"} & set(missing):
            names = " ".join(environment.EXPECTED[module] for module in missing)
            raise environment.SetUpFailed(
                f"{notes[-1]}; make the kit with WITH='{names}'"
            )
        native, note = _native()
        folder = _loaders(kit, loaders)
        notes.append(note)
        notes.append(
            "loaders: " + ("this machine's" if folder is None else "the kit's")
        )
        for line in notes:
            say(line)
        seconds = time.monotonic() - start_s
        self.add(Outcome("set-up", "; ".join(notes), DONE, seconds, seconds))
        return python, environment.variables(
            python=python, commit=self.commit, loaders=folder, native=native
        )

    def run(self, step: Step, python: Path, variables: dict[str, str]) -> None:
        """Run a step, if there is time for it."""
        limit_s = self.budget.limit_s(QUICK_LIMIT_S if self.is_quick else step.limit_s)
        if step.needs_torch and self.hardware.get("torch") == "":
            self._pass_over(step, LEFT_OUT, "torch is not on this machine")
        elif limit_s == 0.0:
            spent = f"the budget of {self.budget.seconds:.0f} s is spent"
            self._pass_over(step, NOT_BEGUN, spent)
        else:
            say(f"{step.name}: {step.what} (at most {limit_s:.0f} s)")
            outcome = self._done(step, limit_s, python, variables)
            if step.name == "machine":
                today = time.strftime("%Y-%m-%d", time.gmtime())
                self.hardware = outcome.content | {"date": today}
            self.add(outcome)

    def _pass_over(self, step: Step, state: str, reason: str) -> None:
        self.add(Outcome(step.name, step.what, state, tail=(reason,)))

    def _done(self, step: Step, limit_s, python: Path, variables) -> Outcome:
        """Run a step's program, and take what it left."""
        words = step.command(is_quick=self.is_quick)
        since_s, logs = time.time(), self.out / "logs"
        state, seconds = run_program(
            [str(python), "-m", *words],
            name=step.name,
            limit_s=limit_s,
            logs=logs,
            cwd=TREE,
            environment=variables,
        )
        out, log = logs / f"{step.name}.out", logs / f"{step.name}.log"
        content = printed_json(out) if step.is_json else {}
        if not content and step.rows_file:
            content = kept_rows(TREE / step.rows_file, since_s)
        return Outcome(
            step.name,
            step.what,
            state,
            seconds,
            limit_s,
            ("python", "-m", *words),
            content,
            last_lines(log) if step.is_json else last_lines(out, log),
        )

    def add(self, outcome: Outcome) -> None:
        """Note how a step went, in its file and in the report."""
        self.outcomes.append(outcome)
        say(f"{outcome.name}: {outcome.state}, {outcome.seconds:.1f} s")
        for each in self.outcomes:  # the first did not know the hardware
            self._write(each)
        page = report_text(
            self.outcomes,
            read_goals(),
            hardware=self.hardware,
            commit=self.commit,
            is_quick=self.is_quick,
        )
        (self.out / "report.md").write_text(page, encoding="utf-8")

    def _write(self, outcome: Outcome) -> None:
        """Write a step's file: what it printed, hardware, commit, how it went."""
        content = {
            **outcome.content,
            "hardware": self.hardware,
            "commit": self.commit,
            "step": {
                "name": outcome.name,
                "state": outcome.state,
                "seconds": outcome.seconds,
                "is_quick": self.is_quick,
                "command": outcome.command,
                "tail": outcome.tail,
            },
        }
        text = json.dumps(content, indent=1) + "\n"
        (self.out / f"{outcome.name}.json").write_text(text, encoding="utf-8")


def _native() -> tuple[Path | None, str]:
    """The folder of the compiled libraries, and what there is to say of it."""
    try:
        folder = environment.native_libraries(TREE / "out")
    except subprocess.CalledProcessError as error:
        line = (error.stderr.strip().splitlines() or ["no word"])[-1]
        return None, f"the native engine could not be compiled: {line}"
    if folder is None:
        return None, "no C compiler: no native engine, and nothing compared with it"
    return folder, "native engine compiled"


def _loaders(kit: Path, wanted: str) -> Path | None:
    """The kit's loaders of OpenGL, where they are asked for or needed."""
    folder = kit / "loaders"
    lacking = [n for n in environment.GL_LIBRARIES if not environment.loads(n)]
    if folder.is_dir() and (wanted == "kit" or lacking):
        return folder
    if lacking:
        raise environment.SetUpFailed(
            f"{', '.join(lacking)} are neither here nor in the kit: make it on a "
            "Debian or Ubuntu machine"
        )
    return None


def _arguments() -> argparse.Namespace:
    names = [step.name for step in all_steps(TREE)]
    parser = argparse.ArgumentParser(prog="run.sh", description=__doc__.split("\n")[0])
    parser.add_argument("--kit", type=Path, required=True, help=argparse.SUPPRESS)
    parser.add_argument("--quick", action="store_true", help="small frames, 15 minutes")
    parser.add_argument("--out", type=Path, help="results; KIT/results")
    parser.add_argument("--steps", nargs="+", choices=names, default=names)
    parser.add_argument("--budget-s", type=float, help="480; quick: 900")
    parser.add_argument("--loaders", choices=("auto", "kit"), default="auto")
    return parser.parse_args()


def main() -> int:
    """Run; 0 where every step was done or had to be left out."""
    arguments = _arguments()
    kit = arguments.kit.resolve()
    out = (arguments.out or kit / "results").absolute()
    usual_s = QUICK_BUDGET_S if arguments.quick else BUDGET_S
    budget = Budget(arguments.budget_s or usual_s)
    commit = (kit / "COMMIT").read_text(encoding="utf-8").strip()
    run = Run(out, commit=commit, is_quick=arguments.quick, budget=budget)
    try:
        python, variables = run.set_up(kit, loaders=arguments.loaders)
    except environment.SetUpFailed as error:
        say(str(error))
        return 1
    for step in all_steps(TREE):
        if step.name in (*arguments.steps, "machine"):
            run.run(step, python, variables)
    archive = out.parent / f"{out.name}.tar.gz"
    with tarfile.open(archive, "w:gz") as file:
        file.add(out, arcname=out.name)
    print((out / "report.md").read_text(encoding="utf-8"))
    say(f"{out / 'report.md'}; everything in {archive}")
    bad = {FAILED, TOO_LONG, NOT_BEGUN}
    return int(any(outcome.state in bad for outcome in run.outcomes))


if __name__ == "__main__":
    sys.exit(main())
