"""Cost laws: fits of known laws, and a small frame's counts and merging error."""

import numpy as np
import pytest
from PIL import Image

from filter_service.constants import THREADS, TILE_SIZE_PX
from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.renderer import FilterRenderer
from tests.benchmarks.bench_cost import (
    BLUR_MRAD,
    STATE,
    CostBench,
    bench,
    plane_view,
)
from tests.benchmarks.cost_law import CostRow, bounds, exponent, laws
from tests.benchmarks.field_pictures import plot_costs
from tests.benchmarks.splat_work import splat_work
from tests.numerical.tile_lists import expected_lists, lights_tile, unpack_fragments

pytestmark = pytest.mark.tools

SIZE = (96, 64)


def row(radius_px, median_ms, stage_ms, **counts):
    counts = {
        "pixel_count": 1000,
        "fragment_count": 900,
        "entry_count": 10,
        "evaluation_count": 640,
        "lit_count": 320,
        "kernel_count": 1,
        "kernel_texel_count": 50,
        **counts,
    }
    return CostRow(
        bench="cost",
        method="merged",
        case="plane",
        setting="",
        n=1,
        median_ms=median_ms,
        p95_ms=median_ms,
        memory_mb=0.0,
        error_name="psnr_db",
        error=50.0,
        reference="",
        sweep="radius",
        radius_px=radius_px,
        merged_ratio=0.0,
        layer_count=2,
        merging_db=None,
        stage_ms=stage_ms,
        **counts,
    )


def test_laws_find_the_exponents_of_known_costs():
    radii_px = np.array([2.0, 4.0, 8.0, 16.0])
    rows = [
        row(r, 3.0 * r**1.5 + 5.0 * r**2, {"splat": 5.0 * r**2, "bin": 3.0 * r**1.5})
        for r in radii_px
    ]
    found = {law.quantity: law for law in laws(rows)}
    assert found["splat"].exponent == pytest.approx(2.0)
    assert found["bin"].exponent == pytest.approx(1.5)
    assert 1.5 < found["frame"].exponent < found["frame"].last_exponent < 2.0
    assert found["evaluations"].exponent == pytest.approx(0.0, abs=1e-9)
    assert exponent(radii_px, 7.0 / radii_px) == pytest.approx(-1.0)


def test_a_pass_is_bound_by_the_unit_it_follows():
    rng = np.random.default_rng(3)
    rows = []
    for n in range(12):
        counts = {
            "pixel_count": int(rng.integers(1e4, 1e6)),
            "entry_count": int(rng.integers(1e4, 1e6)),
            "evaluation_count": int(rng.integers(1e6, 1e8)),
        }
        splat_ms = 2e-6 * counts["evaluation_count"] * (1.0 + 0.05 * (n % 2))
        fragments_ms = 3e-5 * counts["pixel_count"]
        stage_ms = {"splat": splat_ms, "fragments": fragments_ms}
        rows.append(row(8.0, splat_ms + fragments_ms, stage_ms, **counts))
    found = {bound.stage: bound for bound in bounds(rows)}
    assert found["splat"].unit == "evaluation"
    assert found["splat"].ns_per_unit == pytest.approx(2.0, rel=0.06)
    assert found["fragments"].unit == "pixel"
    assert found["fragments"].spread_ratio == pytest.approx(1.0)


def test_one_sweep_is_enough_for_a_plot(tmp_path):
    rows = [row(r, r**2, {"splat": r**2}) for r in (2.0, 4.0, 8.0)]
    plot_costs(rows, tmp_path / "pictures" / "cost.png")
    with Image.open(tmp_path / "pictures" / "cost.png") as picture:
        assert picture.size[0] > 300


@pytest.fixture(scope="module")
def plane_rows(gpu: Gpu):
    found = {}
    for radius_px in (4, 8, 16):
        view = plane_view(*SIZE, BLUR_MRAD / radius_px)
        case = CostBench(FilterRenderer(gpu), view)
        for line in bench(case, "radius", "plane", float(radius_px)):
            found[line.method, radius_px] = line
    return found


def test_evaluations_are_those_of_discs_over_tiles(plane_rows):
    for radius_px in (4, 8):
        line = plane_rows["unmerged", radius_px]
        # A pixel's disc meets tiles within its own reach, and no others.
        across = (2.0 * radius_px + TILE_SIZE_PX) / TILE_SIZE_PX
        tiles = line.evaluation_count / THREADS / line.pixel_count
        assert np.pi * radius_px**2 / THREADS < tiles <= (across + 0.5) ** 2
        # An entry is of a bin of four tiles.
        assert 1.0 < line.evaluation_count / THREADS / line.entry_count < 4.0
        assert line.error >= 60.0


@pytest.mark.parametrize("merge", [False, True])
def test_evaluations_are_counted_as_they_happen(gpu, merge):
    """Against comparing every fragment with every pixel; the last tiles are cut."""
    width, height = 77, 43
    case = CostBench(FilterRenderer(gpu), plane_view(width, height, BLUR_MRAD / 6))
    frame = case.renderer.render(case.view, case.handle, **STATE, merge=merge)
    found = splat_work(gpu, (width, height), frame.entry_count)
    columns, rows = (-(-side // TILE_SIZE_PX) for side in (width, height))
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
    lists = expected_lists(fragments, (width, height), hidden_from=len(place))
    assert found.entry_count == lists.offsets[-1]
    with pytest.raises(ValueError, match="entries of the fragments in the buffers"):
        splat_work(gpu, (width, height), frame.entry_count + 1)


def test_merged_work_does_not_grow_with_the_square_of_the_radius(plane_rows):
    work = {key: line.evaluation_count for key, line in plane_rows.items()}
    assert work["unmerged", 16] >= 2.0 * work["unmerged", 8]
    assert work["merged", 16] <= 1.5 * work["merged", 8]
    for radius_px in (4, 8, 16):
        assert plane_rows["merged", radius_px].merging_db >= 45.0
