"""Arrays with named axes, and the states that arguments of `Eye` describe."""

import numpy as np
import pytest

from estimator import Eye, load_profile, parse_profile, prepare_eye
from estimator.image_quality.labeled_array import labeled
from estimator.image_quality.states import state_grid


@pytest.fixture
def table():
    """Two pupils, three places with two angles each, two quantities."""
    return labeled(
        np.arange(12.0).reshape(2, 3, 2),
        ("pupil_diameter_mm", "place", "quantity"),
        {
            "h_deg": [0.0, 10.0, 20.0],
            "v_deg": [0.0, 5.0, 5.0],
            "pupil_diameter_mm": [3.0, 5.0],
            "wavelength_nm": 555.0,
            "quantity": ["log_mar", "visual_strehl_ratio"],
        },
        name="acuity",
        coord_dims={"h_deg": ("place",), "v_deg": ("place",)},
        notes=("a note",),
    )


def test_numpy_accepts_an_array_and_cannot_change_it(table):
    assert np.asarray(table).sum() == 66.0
    assert np.mean(table) == 5.5
    assert np.array(table, dtype=np.float32).dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        table.values[0] = 1.0
    assert len(table) == 2
    assert table.sizes == {"pupil_diameter_mm": 2, "place": 3, "quantity": 2}


def test_values_are_found_by_coordinates(table):
    found = table.sel(pupil_diameter_mm=5, quantity="log_mar")
    assert found.dims == ("place",)
    assert found.values.tolist() == [6.0, 8.0, 10.0]
    assert found.coords["pupil_diameter_mm"] == 5.0
    assert found.coords["h_deg"].tolist() == [0.0, 10.0, 20.0]
    third = table.sel(place=2)
    assert float(third.coords["h_deg"]) == 20.0
    assert third.dims_of("h_deg") == ()
    assert float(third["log_mar"].sel(pupil_diameter_mm=3)) == 4.0
    assert table["log_mar"].name == "log_mar"
    assert "quantity" not in table["log_mar"].coords


@pytest.mark.parametrize(
    ("at", "said"),
    [
        ({"pupil_diameter_mm": 4}, r"expected one of \[3.0, 5.0\]"),
        ({"pupil_mm": 4}, "expected one of the axes pupil_diameter_mm, place"),
        ({"quantity": "modulation"}, "expected one of"),
    ],
)
def test_other_coordinates_are_named(table, at, said):
    with pytest.raises(KeyError, match=said):
        table.sel(**at)
    with pytest.raises(KeyError, match="no axis of quantities"):
        table["log_mar"]["log_mar"]


def test_rows_have_coordinates_and_a_column_for_each_quantity(table):
    assert table.columns() == [
        *("place", "h_deg", "v_deg", "pupil_diameter_mm", "wavelength_nm"),
        *("log_mar", "visual_strehl_ratio"),
    ]
    rows = list(table.rows())
    assert len(rows) == 6
    assert rows[4] == [1, 10.0, 5.0, 5.0, 555.0, 8.0, 9.0]
    one = table.sel(place=0)["log_mar"]
    assert one.columns()[-1] == "log_mar"
    assert list(one.rows())[1] == [0.0, 0.0, 5.0, 555.0, 6.0]
    assert "log_mar (pupil_diameter_mm: 2)" in repr(one)
    assert "h_deg (place): 0, 10, 20" in repr(table)


def test_a_frame_of_pandas_has_these_rows(table):
    pandas = pytest.importorskip("pandas")
    frame = table.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.columns.tolist() == table.columns()
    assert frame.query("h_deg == 10 and pupil_diameter_mm == 5").log_mar.item() == 8.0


def test_an_array_of_xarray_has_the_same_axes(table):
    pytest.importorskip("xarray")
    found = table.to_xarray()
    assert found.dims == table.dims
    assert found.sel(pupil_diameter_mm=5.0, quantity="log_mar").values.tolist() == [
        *(6.0, 8.0, 10.0)
    ]
    assert found.coords["h_deg"].dims == ("place",)
    assert found.attrs["notes"] == ["a note"]


@pytest.mark.long("loads matplotlib")
def test_lines_are_drawn_over_the_longest_axis(table):
    figure = table.plot(x="pupil_diameter_mm")
    first, second = figure.axes
    assert len(first.lines) == 3
    assert first.lines[1].get_ydata().tolist() == [2.0, 8.0]
    assert first.get_ylabel() == "acuity, logMAR"
    assert second.lines[2].get_ydata().tolist() == [5.0, 11.0]
    with pytest.raises(ValueError, match="expected an axis of more than one number"):
        table.plot(x="quantity")
    with pytest.raises(ValueError, match="there is none"):
        table.sel(place=0, pupil_diameter_mm=3).plot()
    many = labeled(np.zeros((50, 60)), ("a", "b"), {}, name="zernike_um")
    with pytest.raises(ValueError, match="50 lines"):
        many.plot()
    with pytest.raises(ValueError, match="complex"):
        labeled(np.zeros(3, complex), ("a",), {}, name="transfer_ratio").plot()


def test_psfs_are_drawn_as_images():
    side = [1.0, 0.0, -1.0]
    kernels = np.zeros((2, 3, 3))
    kernels[:, 0, 1], kernels[1, 2, 2] = 1.0, 0.01
    found = labeled(
        kernels,
        ("h_deg", "y_arcmin", "x_arcmin"),
        {"h_deg": [0.0, 20.0], "y_arcmin": side, "x_arcmin": side[::-1]},
        name="light_ratio",
    )
    figure = found.plot()
    shown = [axes.images[0] for axes in figure.axes]
    assert shown[1].get_array()[2, 2] == pytest.approx(-2.0)  # powers of ten
    assert shown[0].get_extent() == [-1.5, 1.5, -1.5, 1.5]
    assert figure.axes[1].get_title() == "h 20 deg"


def test_lists_are_combined_and_shared_axes_are_not():
    grid = state_grid({"pupil_diameter_mm": [3, 5], "object_dpt": [0, 1, 2]})
    assert grid.dims == ("pupil_diameter_mm", "object_dpt")
    assert grid.shape == (2, 3)
    assert grid.flat["object_dpt"].tolist() == [0.0, 1.0, 2.0] * 2
    assert grid.flat["pupil_diameter_mm"].tolist() == [3.0] * 3 + [5.0] * 3
    assert grid.flat["h_deg"].tolist() == [0.0] * 6
    places = {"h_deg": ("place", [0, 20]), "v_deg": ("place", [0, 5])}
    grid = state_grid({**places, "wavelength_nm": [450, 650]})
    assert grid.dims == ("place", "wavelength_nm")
    assert grid.flat["v_deg"].tolist() == [0.0, 0.0, 5.0, 5.0]
    assert grid.coord_dims == {"h_deg": ("place",), "v_deg": ("place",)}
    assert np.isnan(grid.flat["focus_dpt"]).all()
    assert "focus_dpt" not in grid.coords
    assert state_grid({}).shape == ()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pupil_diameter_mm": [3, 40]}, "pupil_diameter_mm 40: expected 0.5 to 12"),
        ({"wavelength_nm": 0.555}, "wavelength_nm 0.555: expected 380 to 780"),
        ({"h_deg": float("nan")}, "h_deg nan: expected -75 to 75"),
        ({"object_dpt": "near"}, "object_dpt 'near': expected a number or a list"),
        ({"h_deg": [[0, 10], [5, 5]]}, r"shape \(2, 2\).*name their axis"),
        ({"h_deg": []}, r"shape \(0,\)"),
        ({"h_deg": ("place", [0, 1], 2)}, "name of axis, list"),
        (
            {"h_deg": ("place", [0, 1]), "v_deg": ("place", [0, 1, 2])},
            "v_deg: 3 values along the axis 'place'; expected 2",
        ),
        ({"h_deg": [0] * 400, "v_deg": [0] * 400}, "400 x 400 states"),
    ],
)
def test_wrong_states_are_named(given, said):
    with pytest.raises(ValueError, match=said):
        state_grid(given)


def test_a_pupil_that_no_light_passes_is_named():
    with pytest.raises(ValueError, match="no light passes the eye at 12 mm"):
        Eye("cataract").wavefront(pupil_diameter_mm=12)


def test_unknown_arguments_are_named():
    eye = Eye("emmetropia")
    with pytest.raises(TypeError, match="'pupil_mm'; expected one of: h_deg, v_deg, p"):
        eye.mtf(pupil_mm=3)
    with pytest.raises(TypeError, match="unknown argument 'object_dpt'"):
        eye.refraction(object_dpt=1.0)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda eye: eye.mtf(frequency_cpd=-1), "frequency_cpd -1: expected 0 to 1000"),
        (
            lambda eye: eye.mtf(frequency_cpd=[70.0], white_light=True),
            "frequency_cpd 70: expected 0 to 60",
        ),
        (lambda eye: eye.psf(pixel_arcmin=0.0), "pixel_arcmin 0: expected 0.01 to 60"),
        (lambda eye: eye.psf(radius_arcmin=1e4), "radius_arcmin 10000: expected 0 to"),
        (
            lambda eye: eye.psf(pixel_arcmin=0.1, h_deg=np.linspace(0.0, 30.0, 100)),
            "100 PSFs of .* use larger pixels or fewer states",
        ),
        (lambda eye: eye.refraction(method="best"), "method 'best': expected one of"),
        (lambda eye: eye.wavefront(plane="retina"), "plane 'retina': expected one of"),
        (lambda eye: eye.through_focus(quantities=["mtf"]), "quantities 'mtf'"),
    ],
)
def test_wrong_arguments_are_named(call, said):
    with pytest.raises(ValueError, match=said):
        call(Eye("emmetropia"))


@pytest.mark.long("estimates five eyes")
def test_an_eye_is_made_from_any_form_of_a_profile(tmp_path):
    body = {"kind": "preset", "name": "myopia"}
    path = tmp_path / "eye.json"
    path.write_text('{"kind": "preset", "name": "myopia"}')
    profiles = ["myopia", body, path, str(path), load_profile("myopia")]
    found = {float(Eye(profile).refraction()["M_dpt"]) for profile in profiles}
    assert len(found) == 1


def test_states_are_traced_once(monkeypatch):
    from estimator.image_quality import traced_states

    calls = []
    trace = traced_states.traced_directions
    monkeypatch.setattr(
        traced_states,
        "traced_directions",
        lambda *given, **state: calls.append(state) or trace(*given, **state),
    )
    eye = Eye("emmetropia")
    eye.wavefront(pupil_diameter_mm=[3, 4], focus_dpt=0.0)
    assert len(calls) == 2
    eye.psf(pupil_diameter_mm=[3, 4], object_dpt=[0, 1, 2], radius_arcmin=5.0)
    assert len(calls) == 2


@pytest.mark.long("wide PSFs")
def test_a_wavefront_too_steep_is_nan_and_noted():
    """-12 dpt through 8 mm: no contrast is left, but the PSF is known."""
    eye = Eye({"kind": "prescription", "eye_side": "OD", "sphere_dpt": -12.0})
    state = {"pupil_diameter_mm": [2.0, 8.0], "focus_dpt": 0.0}
    found = eye.mtf(frequency_cpd=[1.0, 10.0], **state)
    assert np.isfinite(found.values[0]).all()
    assert np.isnan(found.values[1]).all()
    assert "1 of 2 wavefronts are too steep to be sampled: NaN" in found.notes
    assert eye.psf(pixel_arcmin=2.0, **state).values.sum() == pytest.approx(2.0)


def test_lenslets_off_the_axis_and_not_before_the_pupil_are_refused():
    """Their center is clear: a narrow pupil on the axis looks past them."""
    lens = {"kind": "lenslets", "sphere_dpt": 0, "vertex_mm": 12}
    eye = Eye({"kind": "preset", "name": "emmetropia", "correction": lens})
    clear = eye.mtf(frequency_cpd=[10.0], pupil_diameter_mm=3.0)
    assert np.isfinite(clear.values).all()
    with pytest.raises(ValueError, match="lenslets"):
        eye.mtf(frequency_cpd=[10.0], pupil_diameter_mm=3.0, h_deg=20.0)
    with pytest.raises(ValueError, match="lenslets"):
        eye.refraction(method="visual_strehl", pupil_diameter_mm=3.0, h_deg=20.0)
    assert eye.psf(pupil_diameter_mm=3.0, h_deg=20.0).values.sum() > 0.99


def test_the_message_on_other_wavelengths_says_how_to_ask():
    optics, _ = prepare_eye(load_profile("emmetropia"))
    state = {"pupil_diameter_mm": 4.0, "accommodation_dpt": 0.0}
    with pytest.raises(ValueError, match=r"in `wavelengths_nm` of `prepare_eye`"):
        optics.total_defocus_dpt(**state, wavelength_nm=555.0)


@pytest.mark.parametrize("eye_model", ["traced", "wavefront"])
def test_total_defocus_includes_the_vergence_of_an_object(eye_model):
    """Through spectacles of -6 dpt at 12 mm, 3 dpt are less."""
    lens = {"sphere_dpt": -6.0, "vertex_mm": 12.0}
    profile = parse_profile({"kind": "preset", "name": "myopia", "correction": lens})
    optics, _ = prepare_eye(profile, eye_model=eye_model)
    state = {
        "pupil_diameter_mm": 4.0,
        "accommodation_dpt": 0.0,
        "wavelength_nm": 536.0,
    }
    far_dpt = optics.total_defocus_dpt(**state)
    near_dpt = optics.total_defocus_dpt(**state, object_dpt=[0.0, 3.0])
    assert near_dpt[0] == far_dpt
    depth_m = (12.0 + 3.05) / 1000.0  # of the pupil behind the lens
    at_lens_dpt = [-6.0, -6.0 - 1.0 / (1.0 / 3.0 - depth_m)]
    far, near = (f / (1.0 - depth_m * f) for f in at_lens_dpt)
    assert near_dpt[1] - far_dpt == pytest.approx(far - near, abs=0.02)
    assert far - near == pytest.approx(2.5, abs=0.05)  # of 3


@pytest.mark.long("transfer functions of one state")
def test_numbers_alone_give_results_without_axes():
    """Each result is the element of the result for lists of one number."""
    eye = Eye("emmetropia")
    white = {"frequency_cpd": 10, "white_light": True, "straylight": True}
    cases = {
        "mtf": ({"frequency_cpd": 10}, {"frequency_cpd": 10, "orientation_deg": 30}),
        "otf": ({"frequency_cpd": 10}, white),
        "contrast_sensitivity": ({"frequency_cpd": 10}, white),
        "encircled_energy": ({"radius_arcmin": 1}, {"radius_arcmin": 1}),
    }
    for method, options in cases.items():
        for given in options:
            found = getattr(eye, method)(**given, pupil_diameter_mm=2)
            assert found.dims == (), method
            numbers = ("frequency_cpd", "orientation_deg", "radius_arcmin")
            lists = {k: [v] if k in numbers else v for k, v in given.items()}
            listed = getattr(eye, method)(**lists, pupil_diameter_mm=2)
            np.testing.assert_array_equal(found.values, listed.values.ravel()[0])
            assert len(list(found.rows())) == 1
            assert repr(found).startswith(f"<LabeledArray {found.name} ()>")
    assert eye.through_focus(defocus_dpt=0).dims == ("quantity",)
    assert eye.acuity().dims == eye.refraction().dims == ("quantity",)
    assert eye.wavefront().dims == ("term",)
    assert eye.psf().dims == ("y_arcmin", "x_arcmin")


@pytest.mark.long("transfer functions of four kinds of light")
def test_coordinates_say_which_light_is_not_of_one_wavelength():
    eye = Eye("emmetropia")

    def light(**options):
        found = eye.mtf(frequency_cpd=[10], pupil_diameter_mm=2, **options)
        names = ("light", "stiles_crawford", "straylight")
        return {k: found.coords[k].item() for k in names if k in found.coords}

    assert light() == {}
    assert light(white_light=True) == {"light": "white", "stiles_crawford": "centered"}
    assert light(stiles_crawford=True) == {"stiles_crawford": "decentered"}
    assert light(straylight=True) == {"straylight": "included"}
    energy = eye.encircled_energy(
        radius_arcmin=[1], white_light=True, pupil_diameter_mm=2
    )
    assert "light: white" in repr(energy)
    assert dict(zip(energy.columns(), next(energy.rows()), strict=True))["light"] == (
        "white"
    )
    assert eye.psf(white_light=True, pixel_arcmin=2).coords["light"] == "white"
