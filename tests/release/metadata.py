"""Check the metadata of the package; say what the owner has yet to choose.

    python -m tests.release.metadata                  of the repository
    python -m tests.release.metadata dist/*           also of distributions

Requires the packages of `sh setup.sh release`.  The exit status is 1 if something is
wrong.  That no license has been chosen is reported, but is not an error.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import HeaderParser
from pathlib import Path
from typing import Any

from tests.release.requirements import project
from tests.source_tree import ROOT

HEADING = re.compile(r"^## (\S+)(?: - (\d{4}-\d\d-\d\d))?$", re.MULTILINE)
CITATION_SCHEMA = "vendor.citation-file-format"


def version_problems(version: str, changelog: str, citation: str) -> list[str]:
    """Return disagreements between the versions of pyproject.toml and of documents."""
    headings = HEADING.findall(changelog)
    if not headings or headings[0] != ("Unreleased", ""):
        return ["CHANGELOG.md: the first section is not 'Unreleased'"]
    problems = []
    newest, date = headings[1] if len(headings) > 1 else ("nothing", "")
    if newest != version:
        problems.append(f"CHANGELOG.md: the newest version is {newest}, not {version}")
    if not all(date for _, date in headings[1:]):
        problems.append("CHANGELOG.md: a version has no date (YYYY-MM-DD)")
    for name, value in (("version", version), ("date-released", f'"{date}"')):
        if f"\n{name}: {value}\n" not in citation:
            problems.append(f"CITATION.cff: {name} is not {value}")
    return problems


def license_problems(table: dict[str, Any], root: Path) -> tuple[list[str], list[str]]:
    """Return what is wrong with the license, and what has yet to be chosen."""
    files = sorted(path.name for path in root.glob("LICEN[CS]E*"))
    if any(line.startswith("License ::") for line in table["classifiers"]):
        return ["pyproject.toml: a license classifier; use the field license"], []
    expression = table.get("license")
    if expression is None and not files:
        how = "add LICENSE, and `license = ...` in pyproject.toml"
        return [], [f"no license chosen ({how})"]
    if expression is None:
        return [f"pyproject.toml: there is {files[0]}, but no license = ..."], []
    if not files:
        return [
            f"pyproject.toml: license is {expression!r}, but there is no LICENSE"
        ], []
    return [], []


def classifier_problems(table: dict[str, Any]) -> list[str]:
    """Return classifiers that package indexes do not know, and missing Pythons."""
    from trove_classifiers import classifiers

    unknown = sorted(set(table["classifiers"]) - classifiers)
    problems = [f"pyproject.toml: unknown classifier {line!r}" for line in unknown]
    lowest = table["requires-python"].removeprefix(">=")
    if f"Programming Language :: Python :: {lowest}" not in table["classifiers"]:
        problems.append(f"pyproject.toml: no classifier for Python {lowest}")
    return problems


def citation_problems(path: Path) -> list[str]:
    """Return what the schema of the Citation File Format says about a file."""
    command = (sys.executable, "-m", "check_jsonschema", "-o", "TEXT")
    command += ("--builtin-schema", CITATION_SCHEMA, str(path))
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode == 0:
        return []
    return [f"{path.name}: {(finished.stdout + finished.stderr).strip()}"]


def distribution_problems(path: Path, table: dict[str, Any]) -> list[str]:
    """Return what is wrong with the metadata in a wheel or sdist."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            names = wheel.namelist()
            (inside,) = (n for n in names if n.endswith(".dist-info/METADATA"))
            text = wheel.read(inside).decode("utf-8")
    elif path.name.endswith(".tar.gz"):
        with tarfile.open(path) as sdist:
            names = sdist.getnames()
            (inside,) = (n for n in names if re.fullmatch(r"[^/]+/PKG-INFO", n))
            member = sdist.extractfile(inside)
            text = member.read().decode("utf-8") if member else ""
    else:
        return []
    headers = HeaderParser().parsestr(text)
    problems = [
        f"{path.name}: {key} is {headers[key]}, not {value}"
        for key, value in (
            ("Name", table["name"]),
            ("Version", table["version"]),
            ("License-Expression", table.get("license")),
        )
        if headers[key] != value
    ]
    wanted = {"NOTICE"} | ({"LICENSE"} if table.get("license") else set())
    for file in wanted - set(headers.get_all("License-File") or ()):
        problems.append(f"{path.name}: License-File does not list {file}")
    for file in wanted:
        if not any(name.endswith(f"/{file}") for name in names):
            problems.append(f"{path.name}: does not contain {file}")
    return problems


def main() -> int:
    """Check everything; return the exit status."""
    parser = argparse.ArgumentParser(description="Check the package's metadata.")
    parser.add_argument("distributions", nargs="*", type=Path)
    arguments = parser.parse_args()
    table = project()
    problems, choices = license_problems(table, ROOT)
    if not table.get("urls"):
        choices.append("no URLs chosen (`[project.urls]` in pyproject.toml)")
    problems += version_problems(
        table["version"],
        (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        (ROOT / "CITATION.cff").read_text(encoding="utf-8"),
    )
    problems += classifier_problems(table)
    problems += citation_problems(ROOT / "CITATION.cff")
    for path in arguments.distributions:
        problems += distribution_problems(path, table)
    for problem in problems:
        print(f"metadata: {problem}", file=sys.stderr)
    for choice in choices:
        print(f"metadata: {choice}")
    if not problems:
        print(f"metadata: version {table['version']}, no errors")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
