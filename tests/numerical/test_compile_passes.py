"""After warming up, frames meet no shader that is not compiled."""

import numpy as np
import pytest

from filter_service.constants import SORT_CAPACITIES
from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.renderer import FilterRenderer, compile_passes
from tests.conftest import Engine
from tests.numerical.synthetic import Bench, texture
from tests.shader_variants import Kind, renderer_variants


@pytest.mark.gl
def test_no_program_is_compiled_by_the_first_frames(rng):
    gpu = Gpu()
    compile_passes(FilterRenderer(gpu))
    compiled = len(gpu.passes.programs)
    sorts = sum(name == "sort_bins" for name, *_ in gpu.passes.programs)
    assert sorts == 2 * (len(SORT_CAPACITIES) + 1)
    known = renderer_variants(Kind(gpu.is_software, gpu.atlas_is_buffer))
    assert set(gpu.passes.programs) == {(v.name, *v.defines) for v in known}
    bench = Bench(
        Engine("gl", gpu),
        {"kind": "preset", "name": "myopia"},
        width_px=96,
        height_px=64,
        vertical_fov_deg=20.0,
        mode="dynamic",
        pupil_range_mm=(4.0, 5.0),
    )
    color = texture(rng, 64, 96)
    for dtype in (np.uint8, np.float32, np.float16):
        view = bench.view(color.astype(dtype), 1.0)
        for accumulation in ("coverage", "paper"):
            for output in ("srgb8", "linear", "linear16"):
                bench.render(view, accumulation=accumulation, output=output)
    assert len(gpu.passes.programs) == compiled
    gpu.close()
