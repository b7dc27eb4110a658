"""The benchmark of what surrounds the passes leaves out the passes alone."""

import pytest

from tests.benchmarks.bench_host import case_rows, hardware_like
from tests.benchmarks.gpu_cases import open_case

pytestmark = pytest.mark.tools


@pytest.fixture(scope="module")
def case():
    gpu = hardware_like()
    yield open_case(gpu, "emmetropia", "small", (192, 108), 1)
    gpu.close()


def test_frames_are_real_again_afterwards(case):
    list(case_rows(case, True, 3))
    _, stages_ms = case.frame({"pupil_diameter_mm": 4.5, "focus_dpt": 0.5})
    assert stages_ms["splat_ms"] > 0.0
