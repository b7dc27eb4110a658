"""A clock that is set while the service runs changes nothing: no wait reads it."""

import ast

import pytest

from tests.source_tree import ROOT

FOLDERS = ("clients", "estimator", "filter_service", "ocufilter")
WALL_CLOCK = {
    ("time", "time"),
    ("time", "time_ns"),
    ("datetime", "now"),
    ("datetime", "utcnow"),
    ("date", "today"),
}
MAY_READ_IT = {
    # file: why
    "filter_service/psfs/store_cache.py": "compares with the times of files",
    "clients/report/make.py": "dates a report",
    "clients/batch/run.py": "dates a manifest",
}


def sources():
    return [
        path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))
    ]


def reads_wall_clock(text):
    """Whether a source calls what a set clock changes."""
    if not any(name in text for name in ("time", "date")):
        return False
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module == "time":
            if {alias.name for alias in node.names} & {"time", "time_ns"}:
                return True
        if isinstance(node, ast.Attribute):
            owner = node.value
            name = getattr(owner, "id", getattr(owner, "attr", None))
            if (name, node.attr) in WALL_CLOCK:
                return True
    return False


@pytest.mark.parametrize(
    "text",
    ["import time\ntime.time()", "from time import time", "datetime.datetime.now()"],
)
def test_a_wall_clock_is_noticed(text):
    assert reads_wall_clock(text)


@pytest.fixture(scope="module")
def readers():
    """Files that read the wall clock; all are parsed."""
    return {
        path.relative_to(ROOT).as_posix()
        for path in sources()
        if reads_wall_clock(path.read_text(encoding="utf-8"))
    }


def test_only_listed_files_read_the_wall_clock(readers):
    assert readers == set(MAY_READ_IT)
