"""Check NOTICE: every package and every data file that others made has an entry.

    python -m tests.release.notices            check
    python -m tests.release.notices --write    update the packages first

The packages are those that `pip install ocufilter` and the extras for users install.
Their licenses are read from the metadata of the environment that runs this program.
Packages that it lacks keep their entry, which is not compared; --write requires all
of them.  Entries of data files are written by hand.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageMetadata

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

from tests.release.requirements import USER_EXTRAS, declared, installed
from tests.source_tree import ROOT

NOTICE = ROOT / "NOTICE"
PACKAGES, NODE_PACKAGES, DATA = "packages", "node packages", "data"
"""Sections of NOTICE, from the line "[packages]" to the line "[end of packages]"."""

SPDX = {
    "apache 2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache software license": "Apache-2.0",
    "mit license": "MIT",
    "isc license": "ISC",
    "3-clause bsd license": "BSD-3-Clause",
    "new bsd": "BSD-3-Clause",
    "python software foundation license": "PSF-2.0",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
}
"""SPDX expressions of other names of licenses in metadata."""

STATED_ELSEWHERE = {
    "pyphen": "GPL-2.0-or-later OR LGPL-2.1-or-later OR MPL-1.1",  # three classifiers
    "docutils": "BSD-2-Clause AND GPL-3.0-or-later",  # of one Emacs file; COPYING.rst
    "openexr": "BSD-3-Clause",  # LICENSE.md
    "pyglet": "BSD-3-Clause",  # LICENSE
    "uvloop": "MIT OR Apache-2.0",  # two classifiers
}
"""Licenses of packages whose metadata have no single name; where they are stated."""

DATA_SUFFIXES = (
    *(".abp", ".csv", ".glb", ".jpg", ".json", ".npz", ".onnx", ".otf", ".png", ".ttf"),
    *(".txt", ".webp", ".zmx"),
)
MADE_HERE = (
    *("constraints.txt", "package.json", ".schema.json", "expected.json"),
    *("tests/benchmarks/results/", "training/results/", "tests/corpus/"),
    "tests/audit/",
)
"""Names and folders of files that need no entry: settings and own results."""


def license_of(package: Distribution) -> str:
    """Return the SPDX expression of a package.

    Raises
    ------
    ValueError
        If the metadata do not state one.
    """
    metadata = package.metadata
    name = _name(package)
    if name in STATED_ELSEWHERE:
        return STATED_ELSEWHERE[name]
    stated = [metadata.get("License-Expression") or "", metadata.get("License") or ""]
    stated += [
        line.rpartition(" :: ")[2]
        for line in metadata.get_all("Classifier") or ()
        if line.startswith("License")
    ]
    for text in stated:
        text = SPDX.get(text.lower(), text)
        if text in ("BSD", "BSD License"):
            return _bsd(package)
        try:
            return canonicalize_license_expression(text)
        except InvalidLicenseExpression:
            continue
    raise ValueError(f"{name}: no license in its metadata; add it to STATED_ELSEWHERE")


def _bsd(package: Distribution) -> str:
    """Return which BSD license the files of a package contain."""
    texts = [
        file.read_text()
        for file in package.files or ()
        if re.fullmatch(r".*dist-info/.*(LICEN[CS]E|COPYING)(\.\w+)?", str(file))
    ]
    has_third_clause = any(re.search(r"neither the name", t, re.I) for t in texts)
    return "BSD-3-Clause" if has_third_clause or not texts else "BSD-2-Clause"


def _name(package: Distribution) -> str:
    return re.sub(r"[-_.]+", "-", package.name).lower()


def source_of(metadata: PackageMetadata) -> str:
    """Return the address of a package's source or home page."""
    pairs = [line.split(", ", 1) for line in metadata.get_all("Project-URL") or ()]
    urls = {label.lower(): url for label, url in pairs}
    for label in ("source", "source code", "repository", "code", "github", "homepage"):
        if label in urls:
            return urls[label]
    return metadata.get("Home-page") or next(iter(urls.values()), "")


def entry_of(package: Distribution) -> str:
    """Return the line of a package in NOTICE."""
    return f"{_name(package)} | {license_of(package)} | {source_of(package.metadata)}"


def section(text: str, name: str) -> list[str]:
    """Return the lines of a section of NOTICE.

    Raises
    ------
    ValueError
        If there is no such section.
    """
    return _parted(text, name)[1].splitlines()


def _parted(text: str, name: str) -> tuple[str, str, str]:
    """Return the text before a section, the section and the text after it."""
    found = re.search(
        rf"(?<=^\[{name}\]\n).*?(?=^\[end of {name}\]$)", text, re.M | re.S
    )
    if found is None:
        raise ValueError(f"NOTICE: no section [{name}]")
    return text[: found.start()], found[0], text[found.end() :]


def package_problems(
    entries: Iterable[str], packages: dict[str, Distribution | None]
) -> list[str]:
    """Return what is wrong with the entries of packages."""
    noted = {line.partition(" | ")[0]: line for line in entries}
    problems = []
    for name, package in packages.items():
        if name not in noted:
            problems.append(f"package {name}: no entry")
        elif package is not None and noted[name] != entry_of(package):
            problems.append(
                f"package {name}: is '{noted[name]}', not '{entry_of(package)}'"
            )
    if None not in packages.values():
        problems += [f"package {n}: not required" for n in noted.keys() - packages]
    return problems


def node_problems(entries: Iterable[str], manifests: Iterable[str]) -> list[str]:
    """Return what is missing among the entries of Node packages.

    Parameters
    ----------
    manifests : iterable of str
        Contents of the files package.json.
    """
    noted = {line.partition(" | ")[0] for line in entries}
    tables = [json.loads(text) for text in manifests]
    kinds = ("dependencies", "devDependencies")
    required = {name for t in tables for kind in kinds for name in t.get(kind, ())}
    problems = [f"Node package {n}: no entry" for n in sorted(required - noted)]
    return problems + [f"Node package {n}: not required" for n in noted - required]


def data_problems(entries: Iterable[str], files: Iterable[str]) -> list[str]:
    """Return what is wrong with the entries of data files."""
    patterns = [line.partition(" | ")[0] for line in entries]
    unused = set(patterns)
    problems = []
    for file in files:
        found = [pattern for pattern in patterns if file.startswith(pattern)]
        unused.difference_update(found)
        is_data = file.endswith(DATA_SUFFIXES) and not any(m in file for m in MADE_HERE)
        if is_data and not found:
            problems.append(f"file {file}: no entry")
    return problems + [f"file {pattern}: does not exist" for pattern in sorted(unused)]


def tracked_files() -> list[str]:
    """Return the files of the repository."""
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return listed.stdout.splitlines()


def main() -> int:
    """Check NOTICE, or update it; return the exit status."""
    parser = argparse.ArgumentParser(description="Check NOTICE.")
    parser.add_argument("--write", action="store_true", help="update the packages")
    arguments = parser.parse_args()
    packages = installed(declared(USER_EXTRAS))
    missing = [name for name, package in packages.items() if package is None]
    text = NOTICE.read_text(encoding="utf-8")
    if arguments.write:
        if missing:
            sys.exit(f"notices: not installed: {', '.join(missing)}")
        lines = [f"{entry_of(p)}\n" for p in packages.values() if p is not None]
        before, _, after = _parted(text, PACKAGES)
        text = before + "".join(lines) + after
        NOTICE.write_text(text, encoding="utf-8")
    entries = section(text, PACKAGES)
    problems = package_problems(entries, packages)
    files = tracked_files()
    manifests = [
        (ROOT / name).read_text(encoding="utf-8")
        for name in files
        if name.endswith("/package.json")
    ]
    problems += node_problems(section(text, NODE_PACKAGES), manifests)
    problems += data_problems(section(text, DATA), files)
    for problem in problems:
        print(f"notices: {problem}", file=sys.stderr)
    n_compared = len(packages) - len(missing)
    print(f"notices: {n_compared} of {len(packages)} packages compared")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
