"""What `make check` compiles is all that the renderer may ask OpenGL for."""

import re

import pytest

from filter_service.constants import SORT_CAPACITIES
from filter_service.gl.passes import (
    SHADER_ROOT,
    load_shader,
    shared_defines,
)
from tests.shader_check import Compilers, check, complaints
from tests.shader_variants import KINDS, Variant, all_variants, renderer_variants

pytestmark = pytest.mark.tools

CONDITION = re.compile(
    r"^\s*#\s*(?:el)?if(?:n?def\s+|\s+defined\()(\w+)\)?\s*$", flags=re.MULTILINE
)
COMPARISON = re.compile(
    r"^\s*#\s*(?:el)?if\s+(\w+)\s*>\s*(\d+)\s*$", flags=re.MULTILINE
)
ANY_CONDITION = re.compile(r"^\s*#\s*(?:el)?if", flags=re.MULTILINE)
INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"', flags=re.MULTILINE)

FAR_WEIGHTS = "vec3 far_weights(uvec4 texel) { return vec3(texel.rgb >> WEIGHT_BITS); }"

PASSES = sorted(path.name.split(".")[0] for path in (SHADER_ROOT / "passes").iterdir())


def source(name):
    """Text of a file below shaders/, and of what it includes."""
    text = (SHADER_ROOT / name).read_text(encoding="utf-8")
    return text + "".join(source(inner) for inner in INCLUDE.findall(text))


def defines_of(name):
    """Defines of each variant of a pass, with those that all passes have."""
    found = [v.defines for v in all_variants() if v.name == name]
    return [{**shared_defines(), **dict(defines)} for defines in found]


def test_every_pass_is_there():
    variants = all_variants()
    assert sorted({v.name for v in variants if v.stage == "comp"}) == PASSES
    draws = {path.name for path in (SHADER_ROOT / "draws").iterdir()}
    assert {f"{v.name}.{v.stage}.glsl" for v in variants if v.stage != "comp"} == draws


@pytest.mark.parametrize("name", PASSES)
def test_every_condition_of_a_pass_is_met_and_not_met(name):
    text, variants = source(f"passes/{name}.comp.glsl"), defines_of(name)
    conditions, comparisons = CONDITION.findall(text), COMPARISON.findall(text)
    assert len(ANY_CONDITION.findall(text)) == len(conditions) + len(comparisons)
    for macro in conditions:
        assert {macro in defines for defines in variants} == {True, False}, macro
    for macro, limit in comparisons:
        assert {defines[macro] > int(limit) for defines in variants} == {True, False}


def test_lists_of_every_length_are_sorted_by_both_rules_on_every_kind():
    for kind in KINDS.values():
        sorts = [
            dict(v.defines) for v in renderer_variants(kind) if v.name == "sort_bins"
        ]
        found = {(sort["CAPACITY"], "PAPER_RULE" in sort) for sort in sorts}
        assert found == {(n, p) for n in (*SORT_CAPACITIES, 0) for p in (False, True)}


@pytest.fixture
def compilers():
    found = Compilers.found()
    if found is None:
        pytest.skip("glslangValidator and spirv-val are not there")
    return found


def test_a_sound_pass_has_no_complaints(compilers):
    assert check(Variant("scan_bins", ()), compilers) == []


def test_a_complaint_names_file_and_line(compilers):
    text, files = load_shader("passes/splat_tiles.comp.glsl", PIXELS_PER_THREAD=8)
    line = source("common/atlas.glsl").splitlines().index(FAR_WEIGHTS) + 1
    wrong = text.replace(FAR_WEIGHTS, FAR_WEIGHTS.replace("vec3(", "vec3x("))
    (said,) = complaints(wrong, files, compilers)
    assert f"ERROR: common/atlas.glsl:{line}: " in said
