"""Our results, read from the committed files or from a fresh run of the benchmarks."""

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from tests.benchmarks.harness import RESULTS, ROOT

TRAINING = ROOT / "training" / "results"
CARDS = ROOT / "estimator" / "networks" / "weights"


class ResultMissing(Exception):
    """A file of results that the page needs is not there."""


@dataclass(frozen=True)
class Measured:
    """Results by name, the fresh ones first.

    Parameters
    ----------
    fresh : Path, optional
        Folder with results of a run just made; what it lacks is as committed.
    """

    fresh: Path | None = None
    _read: dict = field(default_factory=dict)

    def path(self, name: str) -> Path:
        """Where a file of results lies.

        Raises
        ------
        ResultMissing
        """
        folders = [RESULTS, TRAINING]
        if self.fresh is not None:
            folders.insert(0, self.fresh)
        for folder in folders:
            if (folder / name).is_file():
                return folder / name
        raise ResultMissing(f"{name} is not in {RESULTS.relative_to(ROOT)}")

    def results(self, name: str) -> dict:
        """Return a whole file, as "field"."""
        if name not in self._read:
            text = self.path(f"{name}.json").read_text(encoding="utf-8")
            self._read[name] = json.loads(text)
        return self._read[name]

    def is_fresh(self, name: str) -> bool:
        """Whether a file is of the run just made."""
        return self.fresh is not None and (self.fresh / f"{name}.json").is_file()

    def rows(self, name: str, **wanted) -> list[dict]:
        """Rows of a file whose fields are as wanted.

        A wanted "start*" is any text that starts so, and a tuple is any of its values.
        """

        def fits(value, one) -> bool:
            if isinstance(one, tuple):
                return value in one
            if isinstance(one, str) and one.endswith("*"):
                return value.startswith(one[:-1])
            return value == one

        return [
            row
            for row in self.results(name)["rows"]
            if all(fits(row.get(key), one) for key, one in wanted.items())
        ]

    def value(self, name: str, column: str, **wanted):
        """One field of the first such row; None where there is none, or it is NaN."""
        for row in self.rows(name, **wanted):
            if row[column] is not None and row[column] == row[column]:
                return row[column]
        return None

    @cached_property
    def cards(self) -> dict[str, dict]:
        """What is known of the networks that the service has."""
        return {
            path.stem: json.loads(path.read_text(encoding="utf-8"))
            for path in sorted(CARDS.glob("*.json"))
        }

    def origin(self, name: str) -> str:
        """Commit, date and machine of a file, in words."""
        content = self.results(name)
        parts = [f"commit {content.get('commit', 'not told')}"]
        if "date" in content:
            parts.append(content["date"])
        machine = content.get("machine")
        if machine is None:
            parts.append("machine not told")
            return ", ".join(parts)
        parts.append(f"{machine['cpu']}, {machine['n_cores']} cores")
        machine = machine | next(iter(content.get("clocks", [])), {})
        renderer = machine.get("renderer") or machine.get("gl_renderer")
        if renderer:
            parts.append(renderer)
        return ", ".join(parts)
