"""What the package requires, as declared and as installed."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.source_tree import ROOT

USER_EXTRAS = (
    *(
        "clients",
        "pyrender",
        "headset",
        "batch",
        "batch-ray",
        "report",
        "web",
        "metrics",
    ),
)
"""Extras for users; all others are for developers.

Not `torch`: users choose its build, with up to 5 GB of other packages for CUDA.
"""


def project() -> dict[str, Any]:
    """Return the table ``project`` of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found: dict[str, Any] = tomllib.loads(text)["project"]
    return found


def declared(extras: Iterable[str] = ()) -> list[str]:
    """Return the names of the required packages and of those of extras."""
    table = project()
    lines = [*table["dependencies"]]
    for extra in extras:
        lines += table["optional-dependencies"][extra]
    return sorted({canonicalize_name(Requirement(line).name) for line in lines})


def installed(names: Iterable[str]) -> dict[str, Distribution | None]:
    """Return packages and everything that they require; None if not installed."""
    found: dict[str, Distribution | None] = {}
    pending = [Requirement(name) for name in names]
    seen: set[tuple[str, frozenset[str]]] = set()
    while pending:
        wanted = pending.pop()
        name = canonicalize_name(wanted.name)
        if (name, frozenset(wanted.extras)) in seen:
            continue
        seen.add((name, frozenset(wanted.extras)))
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            found[name] = None
            continue
        pending += _requires(found[name], wanted.extras)
    return dict(sorted(found.items()))


def _requires(package: Distribution, extras: set[str]) -> Iterator[Requirement]:
    for line in package.requires or ():
        wanted = Requirement(line)
        environments = [{"extra": extra} for extra in ("", *extras)]
        if wanted.marker is None or any(map(wanted.marker.evaluate, environments)):
            yield wanted
