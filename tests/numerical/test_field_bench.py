"""The field benchmark's own parts: kept rows, states, targets, published figures."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image

from tests.benchmarks.bench_field import (
    FieldRow,
    KeptRows,
    random_states,
    target_rows,
)
from tests.benchmarks.field_methods import FOCUS_RANGE_DPT, METHODS, PAPER_RANGES
from tests.benchmarks.field_pictures import error_figure, plot_errors
from tests.benchmarks.published_figures import CONDITIONS, published
from tests.numerical.scene_frames import SCENES

pytestmark = pytest.mark.tools

ROW = FieldRow(
    bench="field",
    method="ours quality",
    case="myopia",
    setting="courtyard 320x180 5.00 mm 0.50 dpt",
    n=3,
    median_ms=20.0,
    p95_ms=21.0,
    memory_mb=3.0,
    error_name="psnr_db",
    error=47.0,
    reference="dense",
    scene="courtyard",
    size="320x180",
    psnr_srgb8_db=44.0,
    ssim_ratio=0.99,
    mean_delta_e=0.3,
    prepare_ms=500.0,
    psf_count=10,
    tap_count=None,
    published=None,
)


def test_rows_are_kept_for_the_commit_and_machine_that_made_them(tmp_path):
    path = tmp_path / "out" / "rows.jsonl"
    first = KeptRows(path, "abc machine", resumes=False)
    first.add("a", ROW)
    assert KeptRows(path, "abc machine", resumes=True).get("a") == ROW
    assert KeptRows(path, "abd machine", resumes=True).get("a") is None
    assert KeptRows(path, "abc machine", resumes=False).get("a") is None
    assert KeptRows(path, "abc machine", resumes=True).get("a") is None


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
    spread_mm = np.ptp([state.pupil_mm for state in states])
    assert spread_mm > 3.0


def test_targets_name_the_worst_row_of_a_method_and_size():
    rows = [
        ROW,
        replace(ROW, error=44.5, case="keratoconus"),
        replace(ROW, error=30.0, method="Celaya"),
        replace(ROW, error=40.0, size="640x360"),
    ]
    found = {line["size"]: line for line in target_rows(rows)}
    assert set(found) == {"320x180", "640x360"}
    assert found["320x180"]["worst_db"] == 44.5
    assert found["320x180"]["worst"].startswith("keratoconus")
    assert (found["320x180"]["below"], found["320x180"]["n"]) == (1, 2)


def test_published_figures_stand_beside_their_methods():
    beside = {method.name: method.published_name for method in METHODS}
    assert beside["Barsky"] == "Barsky"
    assert beside["ours on-axis"] == beside["paper alpha 1 tap"] == "paper on-axis"
    assert beside["ours dynamic"] == beside["paper quality"] == "paper off-axis"
    assert beside["Barsky frozen"] == "Barsky"
    assert beside["Celaya"] is None
    # Tables 7 and 10 of the paper
    on_axis = published("paper on-axis", "keratoconus", "primitives")
    assert (on_axis.median_ms, on_axis.psnr_srgb8_db) == (12.93, 45.77)
    assert "TITAN Xp" in on_axis.hardware
    off_axis = published("paper off-axis", "cataract", "primitives")
    assert (off_axis.median_ms, off_axis.psnr_srgb8_db) == (13.4, 44.8)
    assert published("paper off-axis", "cataract", "courtyard") is None
    assert published(None, "cataract", "courtyard") is None


def test_layouts_that_are_not_written_to_be_fast_have_no_time():
    timed = {method.name for method in METHODS if method.timed}
    assert {"ours dynamic", "ours dynamic frozen", "Gonzalez", "Barsky frozen"} <= timed
    assert not any(name.startswith(("paper", "predecessor")) for name in timed)


def _points(axes):
    """Points (n, 2) of each line by its label or number."""
    return {line.get_label(): line.get_xydata() for line in axes.get_lines()}


def test_the_plot_has_the_medians_of_each_size():
    points = [
        ("2x2", 40.0, 40.0),
        ("2x2", 20.0, 60.0),
        ("2x2", 30.0, 40.0),
        ("1x2", 5.0, 20.0),
    ]
    rows = [replace(ROW, size=s, median_ms=ms, error=db) for s, ms, db in points]
    time, *_ = error_figure(rows).axes
    found = _points(time)["ours quality"]
    np.testing.assert_allclose(found, [[5.0, 0.1], [30.0, 0.01]])


def test_each_axis_has_one_kind_of_error_and_only_times_taken_alike(tmp_path):
    theirs = asdict(published("paper on-axis", "myopia", "courtyard"))
    rows = [
        ROW,
        replace(ROW, method="ours quality frozen", median_ms=10.0),
        replace(ROW, size="640x360", median_ms=80.0, published=theirs),
        replace(ROW, method="paper quality", n=0, median_ms=None, tap_count=10**6),
    ]
    time, work, eight_bits = error_figure(rows).axes
    assert set(_points(time)) == {"ours quality", "ours quality frozen"}
    rms = 10 ** (-ROW.error / 20)
    assert np.allclose(_points(time)["ours quality"], [[20.0, rms], [80.0, rms]])
    assert np.allclose(_points(work)["paper quality"], [[1e6 / (320 * 180), rms]])
    shown_db = np.concatenate([points[:, 0] for points in _points(eight_bits).values()])
    assert set(shown_db) == {ROW.psnr_srgb8_db, theirs["psnr_srgb8_db"]}
    plot_errors(rows, tmp_path / "field.png")
    with Image.open(tmp_path / "field.png") as picture:
        assert picture.size[0] > 300
