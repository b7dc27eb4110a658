"""The benchmark of what surrounds the passes leaves out the passes alone."""

import re

import pytest

from tests.benchmarks.bench_gpu import open_case
from tests.benchmarks.bench_host import case_rows, hardware_like


@pytest.fixture(scope="module")
def case():
    gpu = hardware_like()
    yield open_case(gpu, "emmetropia", "small", (192, 108), 1)
    gpu.close()


@pytest.mark.parametrize("is_moving", [False, True])
def test_frames_on_nothing_do_all_but_the_passes(case, is_moving):
    rows = {row.method: row for row in case_rows(case, is_moving, 10)}
    told = {
        name: int(count)
        for count, name in re.findall(r"(\d+) (\w+)", rows["all"].setting)
    }
    assert told["waits"] == 1
    assert told["dispatches"] >= (12 if is_moving else 10)
    assert told["bindings"] <= (25 if is_moving else 10), "most stay bound"
    assert told["copies"] == (11 if is_moving else 10)
    parts = ("image copies", "driver's copies", "rest")
    assert all(0.0 < rows[name].median_ms < rows["all"].median_ms for name in parts)
    assert (rows["plans of it"].median_ms > 0.05) == is_moving
    assert all(row.error > 90.0 for row in rows.values()), "real frames, before"


def test_frames_are_real_again_afterwards(case):
    list(case_rows(case, True, 3))
    _, stages_ms = case.frame({"pupil_diameter_mm": 4.5, "focus_dpt": 0.5})
    assert stages_ms["splat_ms"] > 0.0
