"""What works without the functions that only Linux has, as far as Linux can show it."""

import re

import pytest

from tests.end_to_end.printed_script import printed_by
from tests.source_tree import ROOT

PAGE = (ROOT / "docs" / "reference" / "systems.md").read_text(encoding="utf-8")


@pytest.mark.clients
@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_frames_are_filtered_in_process_and_by_a_service(
    real_service, tmp_path, system
):
    script = ROOT / "tests" / "end_to_end" / "other_system.py"
    printed = printed_by(script, system, real_service.endpoint, cwd=tmp_path)
    in_process, by_service = printed.split()
    assert in_process == by_service
    assert int(in_process) > 0


def test_the_files_that_the_page_names_have_what_it_says():
    rows = re.findall(r"^\| `([\w/.]+\.(?:py|c|h))` \| (.*?) \|", PAGE, re.MULTILINE)
    assert len(rows) > 15
    for name, what in rows:
        source = (ROOT / name).read_text(encoding="utf-8")
        for word in re.findall(r"`([\w./]+)`", what):
            assert word in source, (name, word)
