"""The field benchmark's own parts: states, targets, medians of the picture."""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.bench_field import (
    FieldRow,
    median_points,
    plot_errors,
    random_states,
    targets,
)
from tests.benchmarks.field_methods import FOCUS_RANGE_DPT, METHODS, PAPER_RANGES
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.numerical.scene_frames import SCENES

pytestmark = pytest.mark.tools

ROW = row_of(
    *("field", "ours quality", "myopia", "courtyard 320x180 5.00 mm 0.50 dpt"),
    *([20.0, 20.0, 21.0], "psnr_db", 47.0, "dense"),
    kind=FieldRow,
    scene="courtyard",
    size="320x180",
    psnr_srgb8_db=44.0,
    prepare_ms=500.0,
    psf_count=10,
    tap_count=None,
)


def test_random_states_differ_and_lie_between_nodes():
    states = [
        random_states(eye, scene, size, 1)[0]
        for eye in CONDITIONS
        for scene in SCENES
        for size in ("320x180", "640x360")
    ]
    assert len(set(states)) == len(states)
    assert states[0] == random_states(CONDITIONS[0], SCENES[0], "320x180", 1)[0]
    for state in states:
        assert 2.0 < state.pupil_mm < 6.0
        assert PAPER_RANGES["focus_range_dpt"][0] < state.focus_dpt < FOCUS_RANGE_DPT[1]
        assert abs(state.pupil_mm - round(state.pupil_mm)) > 1e-3
    assert np.ptp([state.pupil_mm for state in states]) > 3.0


def test_targets_name_the_worst_row_of_a_method_and_size():
    rows = [
        ROW,
        replace(ROW, error=44.5, case="keratoconus"),
        replace(ROW, error=30.0, method="Celaya"),
        replace(ROW, error=40.0, size="640x360"),
    ]
    found = {line["size"]: line for line in targets(rows)}
    assert set(found) == {"320x180", "640x360"}
    assert found["320x180"]["worst_db"] == 44.5
    assert found["320x180"]["worst"].startswith("keratoconus")
    assert (found["320x180"]["below"], found["320x180"]["n"]) == (1, 2)


def test_layouts_that_are_not_written_to_be_fast_have_no_time():
    timed = {method.name for method in METHODS if method.timed}
    assert {"ours dynamic", "Gonzalez", "Barsky"} <= timed
    assert not any(name.startswith(("paper", "predecessor")) for name in timed)


def test_the_plot_has_the_medians_of_each_size(tmp_path):
    points = [
        ("2x2", 40.0, 40.0),
        ("2x2", 20.0, 60.0),
        ("2x2", 30.0, 40.0),
        ("1x2", 5.0, 20.0),
    ]
    rows = [replace(ROW, size=s, median_ms=ms, error=db) for s, ms, db in points]
    found = sorted(median_points(rows, "median_ms"))
    np.testing.assert_allclose(found, [[5.0, 0.1], [30.0, 0.01]])
    untimed = replace(ROW, method="paper quality", median_ms=np.nan)
    plot_errors([*rows, untimed], tmp_path / "field.png")
    assert (tmp_path / "field.png").stat().st_size > 5000
