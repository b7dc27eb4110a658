"""The Python examples of each page run as printed, one after the other."""

import re

import pytest

from tests.end_to_end.printed_script import printed_by
from tests.source_tree import ROOT

PAGES = sorted(
    path
    for path in (ROOT / "docs").rglob("*.md")
    if "```python\n" in path.read_text(encoding="utf-8")
)


def example_of(path) -> str:
    """Return the examples of a page as one script; fragments are marked ``py``."""
    text = path.read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


@pytest.mark.long("a process of its own traces and computes eyes")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, marks=[] if p.stem == "python" else pytest.mark.clients)
        for p in PAGES
    ],
    ids=lambda path: path.stem,
)
def test_the_examples_of_a_page_run(path, tmp_path):
    script = tmp_path / "example.py"
    script.write_text(example_of(path), encoding="utf-8")
    printed = printed_by(script, cwd=tmp_path)
    if path.stem == "python":
        lines = printed.splitlines()
        assert lines[0].startswith("(90, 160, 3) 1 ('blurred: nothing beyond 17 cm")
        contrasts = [float(line.split()[1]) for line in lines[1:4]]
        assert contrasts == sorted(contrasts, reverse=True)
        assert contrasts[2] < 0.6 * contrasts[0]
        assert lines[4] == "float32 True"
        assert lines[5] in ("1", "2")
        assert f"print(error)  # {lines[7]}\n" in path.read_text(encoding="utf-8")
    if path.stem == "opengl":
        assert printed == "1 0\nTrue\n"
    if path.stem == "bands":
        shapes = "(36, 64, 14) (36, 64, 3) (36, 64, 3)"
        assert printed == f"{shapes}\nTrue\n(36, 64, 3)\nTrue (36, 64, 3)\n"
    if path.stem == "gradients":
        assert printed == "True\n(32, 48, 3) True\n"
    if path.stem == "stereo":
        assert printed == "[(90, 160, 3), (90, 160, 3)]\n"
    if path.stem == "correct":
        assert printed == "(64, 96, 3) True\nTrue\n(64, 96, 3) True\n-2.0 True\n"
    if path.stem == "stream":
        assert re.fullmatch(r"\(90, 160, 3\) [\d.]+ ms\n", printed)
    if path.stem == "pyrender":
        lines = [line.split(") ") for line in printed.splitlines()]
        assert [shape for shape, _ in lines] == ["(90, 160, 3"] * 3
        pupils_mm = [float(state.split()[0]) for _, state in lines]
        assert (pupils_mm[0], pupils_mm[2]) == (3.0, 5.0)
    if path.stem == "measurements":
        words, noll_um, estimated = printed.splitlines()[:3]
        assert "tail of the image of a point points up" in words
        assert noll_um.startswith("[")
        eye_length_mm, error_um = map(float, estimated.split())
        assert 20.0 < eye_length_mm < 30.0
        assert error_um < 1e-3
        assert printed.splitlines()[-1] == "1.0"


@pytest.mark.clients
def test_the_readme_s_example_prints_what_it_shows(tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    example = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL)
    assert printed_by("-c", example[1], cwd=tmp_path) == example[2]
