"""Persons drawn from the population: profiles, fields, and `ocufilter field`."""

import json

import numpy as np
import pytest

from estimator import drawn_profiles, load_profile, parse_profile
from estimator.field.field_figure import field_figure
from estimator.field.field_table import DrawnFields, drawn_fields, field_table
from tests.commands import run_command

MYOPE = {"kind": "prescription", "sphere_dpt": -2.0, "age_years": 30}
STATES = {
    "h_deg": [-20.0, 0.0, 20.0],
    "v_deg": 0.0,
    "pupil_diameter_mm": 4.0,
    "wavelength_nm": 555.0,
}
PEOPLE = 2


def test_persons_are_the_first_samples():
    profiles = drawn_profiles(parse_profile(MYOPE | {"sample": 7}), 3)
    expected = [parse_profile(MYOPE | {"sample": k}) for k in range(3)]
    assert [p.digest for p in profiles] == [p.digest for p in expected]


@pytest.mark.parametrize("count", [1, 1001, -5])
def test_a_count_out_of_range_is_named(count):
    with pytest.raises(ValueError, match=f"people is {count}; allowed: 2 to 1000"):
        drawn_profiles(parse_profile(MYOPE), count)


@pytest.mark.parametrize(
    ("profile", "reason"),
    [
        ({"kind": "published", "name": "le_grand_relaxed"}, "gives the eye itself"),
        (
            {
                "kind": "pseudophakic",
                "axial_length_mm": 23.6,
                "keratometry_dpt": [43, 43],
                "lens_center_mm": 4.9,
                "implant": {"power_dpt": 21},
            },
            "gives the eye itself",
        ),
        (
            {"kind": "preset", "name": "keratoconus", "periphery": "model"},
            "wavefront on the axis is measured and 'periphery' is model",
        ),
        (
            MYOPE | {"higher_order": "none", "periphery": "model"},
            "'higher_order' is none and 'periphery' is model",
        ),
    ],
)
def test_nothing_to_draw_is_refused_with_the_reason(profile, reason):
    with pytest.raises(ValueError, match=f"nothing to draw, because .*{reason}"):
        drawn_profiles(parse_profile(profile), 2)


@pytest.mark.parametrize(
    "profile",
    [
        MYOPE | {"periphery": "model"},
        MYOPE | {"higher_order": "none"},
        {"kind": "preset", "name": "keratoconus"},
    ],
)
def test_persons_with_something_to_draw_differ(profile):
    drawn = drawn_fields(parse_profile(profile), 2, **STATES)
    assert np.ptp(drawn.power_dpt[:, 0, 0]) > 0.01
    assert np.ptp(drawn.power_dpt[:, 1, 0]) < 0.005  # the axis, through 4 mm


@pytest.fixture(scope="module")
def tables():
    return [
        field_table(parse_profile(MYOPE | {"sample": k}), **STATES)
        for k in range(PEOPLE)
    ]


def _field(tmp_path, *arguments):
    path = tmp_path / "eye.json"
    path.write_text(json.dumps(MYOPE), encoding="utf-8")
    at = ["--pupil-mm", "4", "--wavelength-nm", "555", "--h-deg=-20,0,20"]
    ended = run_command("field", path, *at, *arguments)
    assert (ended.returncode, ended.stderr) == (0, "")
    return ended.stdout


def test_json_adds_percentiles_and_keeps_the_rest(tmp_path, tables):
    plain = json.loads(_field(tmp_path, "--json"))
    found = json.loads(_field(tmp_path, "--json", "--people", str(PEOPLE)))
    assert found["people"] == PEOPLE
    assert len(found["notes"]) == len(plain["notes"]) + 1
    assert (
        f"{PEOPLE} persons: the higher orders on the axis and the periphery"
        in (found["notes"][-1])
    )
    quantities = {
        "M_dpt": [t.power_dpt[:, 0] for t in tables],
        "J0_dpt": [t.power_dpt[:, 1] for t in tables],
        "J45_dpt": [t.power_dpt[:, 2] for t in tables],
        "coma_um": [np.hypot(*t.zernike_um[:, [7, 8]].T) for t in tables],
        "higher_order_rms_um": [
            np.sqrt((t.zernike_um[:, 6:] ** 2).sum(axis=1)) for t in tables
        ],
    }
    for k, direction in enumerate(found["directions"]):
        percentiles = direction.pop("percentiles")
        assert direction == plain["directions"][k]
        assert set(percentiles) == set(quantities)
        for name, of_people in quantities.items():
            for p in (5, 50, 95):
                expected = np.percentile([values[k] for values in of_people], p)
                assert percentiles[name][str(p)] == pytest.approx(expected, abs=1e-6)


def test_the_table_has_the_radius_beside_the_pupil(tmp_path):
    *_, pupil, header, _, axis, _ = _field(tmp_path).splitlines()
    assert pupil == "prescription, entrance pupil diameter 4 mm"
    assert header.split()[-2:] == ["radius", "mm"]
    assert float(axis.split()[-1]) == pytest.approx(2.0, abs=0.01)


def test_the_table_has_median_and_range(tmp_path, tables):
    lines = _field(tmp_path, "--people", str(PEOPLE)).splitlines()
    assert f"median and 5th..95th percentile of {PEOPLE} persons" in lines
    rows = [line.split() for line in lines[-3:]]
    for k, row in enumerate(rows):
        m_dpt = [table.power_dpt[k, 0] for table in tables]
        low, median, high = np.percentile(m_dpt, (5, 50, 95))
        assert float(row[2]) == pytest.approx(median, abs=0.006)
        printed = [float(v) for v in row[3].split("..")]
        assert printed == pytest.approx([low, high], abs=0.006)


@pytest.mark.parametrize(
    ("profile", "arguments", "said"),
    [
        ("myopia", ["--people", "1"], "--people is 1; allowed: 2 to 1000"),
        ("myopia", ["--people", "1001"], "--people is 1001; allowed: 2 to 1000"),
        ("le_grand_relaxed", ["--people", "5"], "the profile gives the eye itself"),
        (
            "myopia",
            ["--people", "1000", "--h-deg", ",".join(["1"] * 1001)],
            "--people: 1000 persons x 1001 directions; allowed: at most 1000000",
        ),
    ],
)
def test_bad_counts_are_one_line(profile, arguments, said):
    at = ["--pupil-mm", "4", "--wavelength-nm", "555"]
    ended = run_command("field", profile, *at, *arguments)
    assert ended.returncode != 0
    assert ended.stdout == ""
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


def _drawn(tables):
    return DrawnFields(
        *(
            np.stack([getattr(table, name) for table in tables])
            for name in DrawnFields.__dataclass_fields__
        )
    )


def test_line_plots_have_the_bands_around_the_median(tables):
    figure = field_figure(tables[0], title="eye", drawn=_drawn(tables))
    m_dpt = np.array([table.power_dpt[:, 0] for table in tables])
    axes = figure.axes[0]
    (line,) = axes.lines
    assert line.get_ydata() == pytest.approx(np.median(m_dpt, axis=0))
    assert len(axes.collections) == 2
    for band, limits in zip(axes.collections, ((5, 95), (25, 75)), strict=True):
        x, y = band.get_paths()[0].vertices.T
        low, high = np.percentile(m_dpt, limits, axis=0)
        for k, h_deg in enumerate(STATES["h_deg"]):
            assert y[x == h_deg].min() == pytest.approx(low[k])
            assert y[x == h_deg].max() == pytest.approx(high[k])
    assert f"{PEOPLE} drawn persons" in figure.get_suptitle()


def test_maps_have_lines_of_half_the_band():
    h_deg, v_deg = np.meshgrid([-20.0, 0.0, 20.0], [-10.0, 0.0, 10.0])
    grid = STATES | {"h_deg": h_deg.ravel(), "v_deg": v_deg.ravel()}
    tables = [
        field_table(parse_profile(MYOPE | {"sample": k}), **grid) for k in range(2)
    ]
    figure = field_figure(tables[0], title="eye", drawn=_drawn(tables))
    m_dpt = [table.power_dpt[:, 0] for table in tables]
    low, high = np.percentile(m_dpt, (5, 95), axis=0)
    filled, lines = figure.axes[0].collections
    assert filled.zmin == pytest.approx(np.median(m_dpt, axis=0).min())
    assert lines.zmax == pytest.approx((high - low).max() / 2.0)
    alone = field_figure(tables[0], title="eye")
    assert len(alone.axes[0].collections) == 1


def test_a_preset_is_measured_on_its_axis():
    drawn = drawn_fields(load_profile("keratoconus"), 2, **STATES)
    assert drawn.coma_um[0, 1] == pytest.approx(drawn.coma_um[1, 1], abs=1e-6)


@pytest.mark.long("draws 18 PSFs")
def test_psfs_over_the_field_are_at_one_scale():
    """Nine columns of 11 x 2 directions, the upper row first."""
    h_deg, v_deg = np.meshgrid(np.arange(-25.0, 26.0, 5.0), [-10.0, 10.0])
    table = field_table(
        load_profile("keratoconus"),
        **STATES | {"h_deg": h_deg.ravel(), "v_deg": v_deg.ravel()},
    )
    figure = field_figure(table, title="eye")
    shown = [axes for axes in figure.axes if axes.images]
    assert len(shown) == 18
    assert shown[0].get_title() == "-25, 10"
    assert shown[-1].get_title() == "25, -10"
    assert len({tuple(axes.images[0].get_extent()) for axes in shown}) == 1
    kernel, side = shown[4].images[0].get_array(), shown[4].images[0].get_extent()[1]
    x = np.arange(-40, 41) * side / 40.5
    light = 10.0**kernel
    spread = np.sqrt((light * (x**2 + x[:, None] ** 2)).sum() / light.sum())
    blur = np.hypot(*[table.power_dpt[16, k] for k in (0, 1)]) * 2.0 / np.sqrt(2.0)
    assert spread == pytest.approx(blur * 3.44, rel=0.35)  # mrad to arcmin
