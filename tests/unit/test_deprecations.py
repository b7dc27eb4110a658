"""Deprecated names warn, and are gone with the version that was announced."""

import re
import tomllib

import numpy as np
import pytest

from estimator.acuity import Transfer, log_mar_of
from filter_service.messages import PROTOCOL_VERSION
from tests.source_tree import PACKAGES, ROOT, python_files


def _version(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")[:2]))


def _current() -> tuple[int, ...]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return _version(tomllib.loads(text)["project"]["version"])


def _rows() -> list[list[str]]:
    page = (ROOT / "docs/reference/versions.md").read_text(encoding="utf-8")
    table = page.partition("## Deprecations")[2]
    rows = [line.strip("| ").split(" | ") for line in re.findall(r"^\|.*", table, re.M)]
    return rows[2:]


def test_no_announced_removal_is_overdue():
    removals = [row[3] for row in _rows()]
    assert removals
    for removal in removals:
        if removal.startswith("protocol "):
            assert int(removal.split()[1]) > PROTOCOL_VERSION
        else:
            assert _version(removal) > _current()


def test_every_warning_names_a_version_to_come():
    files = [path for package in PACKAGES for path in python_files(package)]
    texts = [path.read_text(encoding="utf-8") for path in files]
    n_warnings = sum(text.count("DeprecationWarning,") for text in texts)
    versions = [
        version
        for text in texts
        for version in re.findall(r"will be removed in version (\d\.\d+)\"", text)
    ]
    assert len(versions) == n_warnings
    assert all(_version(version) > _current() for version in versions)


def test_the_number_of_bisections_of_acuity_is_deprecated():
    frequency_cpd = np.arange(-40, 41) * 0.05
    transfer = Transfer(frequency_cpd, np.eye(81)[::-1] + 0j)
    with pytest.deprecated_call(match="n_bisections has no effect"):
        found = log_mar_of(transfer, n_bisections=8)
    assert found == log_mar_of(transfer)
