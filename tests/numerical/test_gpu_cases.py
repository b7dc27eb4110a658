"""Benchmarks of the engine gl: work is counted as the passes count it; textures."""

import moderngl
import pytest

from tests.benchmarks.bench_gpu import forecast_rows
from tests.benchmarks.gpu_cases import STATE, TextureCase, open_case
from tests.benchmarks.pass_work import (
    RATES,
    FrameWork,
    PassWork,
    rates_of,
    searched_blocks,
)

pytestmark = pytest.mark.tools

SIZE_PX = (192, 108)


@pytest.fixture(scope="module")
def case(gpu):
    case = open_case(gpu, "emmetropia", "small", SIZE_PX, 1)
    yield case
    case.release()


def test_counts_are_those_of_the_frame(case):
    seen = case.renderer.render(case.view, case.handles[0], output="srgb8", **STATE)
    work = case.work
    assert work.fragments == seen.fragment_count
    assert work.entries == seen.entry_count
    assert work.kernels == seen.kernel_count
    assert work.texels == seen.kernel_texel_count
    assert work.sorted_entries <= work.entries <= work.tests
    assert work.entries < work.evaluations / 64 <= 4 * work.entries


def test_searched_blocks():
    tiles, bins, reach_px = (24, 14), (12, 7), 20
    steps = 3  # 21.5 px
    expected = sum(
        (min(2 * x + 2 + steps, 24) - max(2 * x - steps, 0))
        * (min(2 * y + 2 + steps, 14) - max(2 * y - steps, 0))
        for x in range(12)
        for y in range(7)
    )
    assert searched_blocks(reach_px, bins, tiles) == expected


def test_the_longest_bound_counts():
    rates = rates_of("NVIDIA H200/PCIe/SSE2")
    assert rates == RATES["H200"]
    assert PassWork(bytes=4.8e9, flops=1e9).bound_ms(rates) == pytest.approx(1.0)
    assert PassWork(bytes=4.8e9, atomics=3.96e6).bound_ms(rates) == pytest.approx(2.0)
    assert rates_of("llvmpipe") is None


def test_an_eye_is_forecast_from_the_other_eyes():
    work = FrameWork(*range(1, 14))
    works = {("a", "view"): work, ("b", "view"): work.times(3.0)}
    slower = {"a": 4.0, "b": 5.0}  # than the bound of a pass
    rows = [
        {
            "case": eye,
            "setting": "view frozen",
            "method": "    splat",
            "median_ms": slower[eye] * own.passes()["splat"].bound_ms(RATES["H200"]),
        }
        for (eye, _), own in works.items()
    ]
    errors = {row.case: row.error for row in forecast_rows(works, {"rows": rows})}
    assert errors == pytest.approx({"a": 5.0 / 4.0 - 1.0, "b": 4.0 / 5.0 - 1.0})


def test_frames_of_textures_are_timed(case):
    context = moderngl.create_context(standalone=True, backend="egl", require=430)
    with context:
        textures = TextureCase(case)
        assert textures.error_db > 75.0
        wall_ms, stages_ms = textures.frame(STATE)
        assert 0.0 < stages_ms["call"] <= wall_ms
        assert textures.gpu_ms(STATE, textures.new_query()) > 0.0
        passes_ms = textures.passes_ms(STATE)
        assert {"fragments_ms", "splat_ms", "show_ms", "sample_ms"} <= passes_ms.keys()
        assert textures.passes_ms(STATE).keys() == passes_ms.keys()
        assert not textures.incomplete_count
        textures.release()
    context.release()
