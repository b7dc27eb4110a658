"""Numbers live in Python; shader passes name them."""

import importlib
import re

import pytest

from tests.source_tree import ROOT

PASSES = sorted((ROOT / "shaders" / "passes").glob("*.comp.glsl"))
COMMON = sorted((ROOT / "shaders" / "common").glob("*.glsl"))

PLAIN_NUMBERS = {0.0, 0.5, 1.0, 2.0}
"""Allowed as they stand; any other number is a `#define` made from constants.py."""

NUMBER = re.compile(
    r"(?<![\w.])(?P<value>0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"(?:[uUfF]|lf|LF)*(?![\w.])"
)
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
DIRECTIVE = re.compile(r"^\s*#\s*(include|version|extension)\b.*$", re.MULTILINE)


def _blank(match: re.Match) -> str:
    return re.sub(r"[^\n]", " ", match[0])  # keeps the line numbers


def literals(text: str) -> list[tuple[int, str]]:
    """(line, number) of every literal that is not one of `PLAIN_NUMBERS`."""
    code = DIRECTIVE.sub(_blank, COMMENT.sub(_blank, text))
    found = []
    for match in NUMBER.finditer(code):
        word = match["value"]
        number = float(int(word, 16)) if word[:2].lower() == "0x" else float(word)
        if number not in PLAIN_NUMBERS:
            found.append((code.count("\n", 0, match.start()) + 1, match[0]))
    return found


@pytest.mark.parametrize("path", PASSES, ids=lambda path: path.stem)
def test_a_pass_has_no_number_of_its_own(path):
    assert literals(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", PASSES, ids=lambda path: path.stem)
def test_a_pass_includes_common_files_only_and_says_what_it_does(path):
    text = path.read_text(encoding="utf-8")
    for included in re.findall(r'#\s*include\s+"([^"]+)"', text):
        assert included.startswith(("common/", "generated/")), included
    heading = text.split("\n\n", 1)[0]
    for word in ("In:", "Out:", "Dispatch:", "Twin:"):
        assert word in heading, f"the opening comment lacks '{word}'"


@pytest.mark.parametrize("path", COMMON, ids=lambda path: path.stem)
def test_a_common_file_has_no_main_and_includes_no_pass(path):
    code = COMMENT.sub(_blank, path.read_text(encoding="utf-8"))
    assert not re.search(r"\bvoid\s+main\s*\(", code)
    assert "passes/" not in code


def test_all_shaders_are_core_glsl_without_vendor_extensions():
    assert PASSES
    for path in PASSES + COMMON:
        assert not re.search(r"#\s*extension", path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("float a = 3.14;", [(1, "3.14")]),
        ("\nint b = 16u * x1.y2;", [(2, "16u")]),
        ("x = 1e-6; // 7\n/* 8 */ y = 0xFF;", [(1, "1e-6"), (2, "0xFF")]),
        ("#version 430\nvec2 c = vec2(0.5, 2.0) * 1.0f - 0u;", []),
        ("#define HALF_WIDTH 12.5", [(1, "12.5")]),
        ("y = .25; z = a[2].w3;", [(1, ".25")]),
    ],
)
def test_the_scanner_finds_every_literal(text, expected):
    assert literals(text) == expected


TWIN = re.compile(r"Twin: ([\w./]+\w)")


@pytest.mark.parametrize("path", PASSES, ids=lambda path: path.stem)
def test_the_twin_that_a_pass_names_exists(path):
    place = TWIN.search(path.read_text(encoding="utf-8"))[1]
    if place.startswith("tests/"):
        assert (ROOT / place).is_file()
        return
    module, _, name = place.rpartition(".")
    if module == "reference":
        module = "tests.reference.render_passes"
    assert hasattr(importlib.import_module(module), name)
