"""Evaluations of the OpenGL splat pass, against every fragment with every pixel."""

import numpy as np
import pytest

from filter_service.constants import THREADS, TILE_SIZE_PX
from tests.benchmarks.splat_work import splat_work
from tests.numerical.synthetic import Bench, texture
from tests.numerical.tile_lists import expected_lists, lights_tile, unpack_fragments

pytestmark = pytest.mark.tools

SIZE = (77, 43)
"""The last tiles are cut."""

EYE = {"kind": "prescription", "sphere_dpt": -2.0}


@pytest.mark.parametrize("merge", [False, True])
def test_evaluations_are_counted_as_they_happen(gl_engine, gpu, rng, merge):
    width, height = SIZE
    bench = Bench(
        gl_engine,
        EYE,
        width_px=width,
        height_px=height,
        vertical_fov_deg=5.0,
        pupil_range_mm=(5.0, 5.0),
        focus_range_dpt=(0.0, 0.0),
    )
    view = bench.view(texture(rng, height, width), np.inf)
    frame = bench.render(view, merge=merge)
    found = splat_work(gpu, SIZE, frame.entry_count)
    columns, rows = (-(-side // TILE_SIZE_PX) for side in SIZE)
    with gpu.context:
        blocks, place, color = (
            gpu.read(gpu.storage(name, 1), (columns * rows * n, 4), dtype)
            for name, n, dtype in (
                ("BLOCKS", 1, np.uint32),
                ("FRAGMENT_PLACE", THREADS, np.uint32),
                ("FRAGMENT_COLOR", THREADS, np.float32),
            )
        )
    fragments = unpack_fragments(blocks, place, color)
    assert len(fragments.slots) == frame.fragment_count
    low = fragments.first - fragments.sides[:, [0, 2]]
    high = fragments.last + fragments.sides[:, [1, 3]]
    evaluations = lit = 0
    for y, x in np.ndindex(rows * TILE_SIZE_PX, columns * TILE_SIZE_PX):
        left, top = x - x % TILE_SIZE_PX, y - y % TILE_SIZE_PX
        of_tile = lights_tile(fragments, left, top)
        evaluations += of_tile.sum()
        lit += (of_tile & (low <= (x, y)).all(1) & ((x, y) <= high).all(1)).sum()
    assert (found.evaluation_count, found.lit_count) == (evaluations, lit)
    lists = expected_lists(fragments, SIZE, hidden_from=len(place))
    assert found.entry_count == lists.offsets[-1]
    with pytest.raises(ValueError, match="entries of the fragments in the buffers"):
        splat_work(gpu, SIZE, frame.entry_count + 1)
