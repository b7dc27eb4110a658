"""The guide's examples run as printed, one after the other, as one script."""

import re
from dataclasses import fields

from filter_service import EyeFilter, Filtered
from tests.end_to_end.printed_script import printed_by
from tests.source_tree import ROOT

GUIDE = (ROOT / "GUIDE.md").read_text(encoding="utf-8")


def test_the_examples_run_and_print_what_they_say(tmp_path):
    script = tmp_path / "guide.py"
    script.write_text("\n".join(re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)))
    lines = printed_by(script, cwd=tmp_path).splitlines()
    assert lines[0].startswith("(90, 160, 3) 1 ")
    assert lines[1] in ("1", "2")
    assert lines[3] in GUIDE, "the error that the page shows is another"
    assert lines[4] == "[(90, 160, 3), (90, 160, 3)]"
    assert lines[5].startswith("(90, 160, 3) ")
    eye_length_mm, error_um = map(float, lines[6].split())
    assert 20.0 < eye_length_mm < 30.0
    assert error_um < 1e-3
    assert len(eval(lines[7])) == 2


def test_the_page_names_every_call_and_answer():
    for name in vars(EyeFilter):
        if not name.startswith("_") and callable(getattr(EyeFilter, name)):
            assert f"`{name}(" in GUIDE, name
    for field in fields(Filtered):
        if field.name not in ("profile_id", "pupil_diameter_mm", "focus_dpt"):
            assert f"`{field.name}`" in GUIDE or field.name == "gaze_deg", field.name
