"""Check that the committed results of benchmarks were measured at one commit."""

from __future__ import annotations

import json

from tests.benchmarks.harness import KEPT_RESULTS, RESULTS


def commits() -> dict[str, list[str]]:
    """Return the results of each commit, without those that keep theirs."""
    found: dict[str, list[str]] = {}
    for path in sorted(RESULTS.glob("*.json")):
        if path.stem not in KEPT_RESULTS:
            content = json.loads(path.read_text(encoding="utf-8"))
            found.setdefault(content.get("commit", "none"), []).append(path.name)
    return found


def differing(found: dict[str, list[str]]) -> list[str]:
    """Return a line for each changed tree, and each commit but the most frequent."""
    most = max(found, key=lambda commit: len(found[commit]), default="")
    return [
        f"results of commit {commit}: {', '.join(names)}"
        for commit, names in found.items()
        if commit != most or commit.endswith("+")
    ]
