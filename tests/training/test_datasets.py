"""Data sets: the same rows whatever makes them, labeled by the tracer itself."""

import numpy as np
import pytest

from estimator.estimate.problem import prior_for_refraction
from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import eye_surfaces, smallest_diameter_mm
from estimator.eye.parameters import EyeParameters, column
from estimator.wavefront.aberrations import wavefront_aberrations
from training.datasets import (
    DataError,
    Recipe,
    draw,
    input_ranges,
    label,
    load,
    read_manifest,
    recipe_of,
    shard_file,
    split,
    write_manifest,
)
from training.generate import generate
from training.population import (
    partly_accommodated_eyes,
    population_eyes,
    population_ranges,
)
from training.tasks import DOMAINS, ellipse_matrix

SMALL = Recipe("on_axis", 96, rows_per_shard=32, seed=5)


@pytest.mark.parametrize("sampling", ["random", "sobol"])
def test_rows_do_not_depend_on_the_order_of_shards(sampling):
    recipe = Recipe("on_axis", 96, rows_per_shard=32, seed=5, sampling=sampling)
    last_first = [draw(recipe, k) for k in (2, 1, 0)][::-1]
    in_order = [draw(recipe, k) for k in range(3)]
    np.testing.assert_array_equal(np.concatenate(last_first), np.concatenate(in_order))
    assert len(np.unique(np.concatenate(in_order), axis=0)) == 96


def test_a_sequence_fills_the_box_more_evenly_than_chance():
    low, high = DOMAINS["on_axis"].ranges.T
    worst = {}
    for sampling in ("random", "sobol"):
        rows = draw(Recipe("on_axis", 256, 256, seed=1, sampling=sampling), 0)
        unit = np.sort((rows - low) / (high - low), axis=0)
        even = (np.arange(256) + 0.5)[:, None] / 256
        worst[sampling] = np.abs(unit - even).max()
    assert np.all((rows >= low) & (rows <= high))
    assert worst["sobol"] < 0.005 < 0.05 < worst["random"]


def test_the_focus_set_is_a_product_of_eyes_and_distances():
    recipe = Recipe("focus", 120, rows_per_shard=80)
    rows = np.concatenate([draw(recipe, 0), draw(recipe, 1)])
    eyes = rows[:, :-1].reshape(12, 10, -1)
    assert np.all(eyes == eyes[:, :1])
    assert len(np.unique(eyes[:, 0], axis=0)) == 12
    low_dpt, high_dpt = DOMAINS["focus"].ranges[-1]
    part = 10.0 * (rows[:, -1].reshape(12, 10) - low_dpt) / (high_dpt - low_dpt)
    assert np.all(np.floor(part) == np.arange(10))
    # every eye at distances of its own
    assert len(np.unique(rows[:, -1].round(9))) == 120


def test_a_shard_of_a_product_holds_whole_eyes():
    with pytest.raises(DataError, match="multiple of 10"):
        Recipe("focus", 120, rows_per_shard=55)


@pytest.mark.parametrize("bad", [{"domain": "moon"}, {"sampling": "dice"}])
def test_a_recipe_names_what_is_allowed(bad):
    with pytest.raises(DataError, match="allowed are"):
        Recipe(**({"domain": "on_axis", "n_rows": 10} | bad))


def test_an_interrupted_set_goes_on_and_ends_the_same(tmp_path, capsys):
    generate(SMALL, tmp_path / "whole")
    generate(SMALL, tmp_path / "resumed")
    shard_file(tmp_path / "resumed", 1).unlink()
    with pytest.raises(DataError, match=r"shard-00001.npz of 3 is missing"):
        load(tmp_path / "resumed")
    generate(SMALL, tmp_path / "resumed")
    generate(SMALL, tmp_path / "shared", rank=1, n_ranks=2)
    generate(SMALL, tmp_path / "shared", rank=0, n_ranks=2)
    whole = load(tmp_path / "whole")
    for other in ("resumed", "shared"):
        found = load(tmp_path / other)
        np.testing.assert_array_equal(found.inputs, whole.inputs)
        np.testing.assert_array_equal(found.targets, whole.targets)
    manifest = read_manifest(tmp_path / "whole")
    assert manifest["n_rows_kept"] + manifest["n_rows_rejected"] == 96
    assert manifest["inputs"][46] == {"name": "wavelength_nm", "low": 450, "high": 900}
    assert "n=1,2 (paper)" in capsys.readouterr().out


def test_a_manifest_names_the_commits_that_its_shards_are_of(tmp_path, monkeypatch):
    for commit in ("first", "second", "third"):
        monkeypatch.setattr("training.generate.commit_id", lambda name=commit: name)
        generate(SMALL, tmp_path)
        if commit == "first":
            shard_file(tmp_path, 1).unlink()
    assert read_manifest(tmp_path)["commit"] == "first, second"


def test_a_folder_of_another_set_is_refused(tmp_path):
    write_manifest(tmp_path, SMALL, commit="none")
    with pytest.raises(DataError, match="another data set"):
        generate(Recipe("on_axis", 96, rows_per_shard=32, seed=6), tmp_path)


@pytest.mark.parametrize(
    "text", ["", "[" * 5000, "5", "[]", '{"format": [1]}', '{"format": 1e999}', "\0"]
)
def test_a_damaged_manifest_is_refused(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(DataError):
        read_manifest(tmp_path)


def test_a_damaged_shard_or_field_is_refused(tmp_path):
    generate(SMALL, tmp_path)
    manifest = read_manifest(tmp_path)
    with pytest.raises(DataError, match="n_rows"):
        recipe_of({**manifest, "n_rows": [12, {}]})
    file = shard_file(tmp_path, 1)
    file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(DataError, match=f"{file.name}: damaged"):
        load(tmp_path)


def test_rows_that_light_does_not_pass_are_counted():
    domain = DOMAINS["field"]
    rows = draw(Recipe("field", 8, 8), 0)
    rows[0, domain.inputs.index("cornea_anterior_radius_mm")] = 2.0
    rows[0, domain.inputs.index("pupil_diameter_mm")] = 7.0
    found = label(domain, rows)
    assert found.n_rejected == 1
    np.testing.assert_array_equal(found.inputs, rows[1:].astype(np.float32))


def test_a_population_is_a_share_of_the_rows_and_the_rest_is_the_box():
    box, mixed = (
        draw(Recipe("on_axis", 400, 400, seed=2, population_ratio=share), 0)
        for share in (1e-9, 0.4)
    )
    exchanged = np.any(box != mixed, axis=1)
    assert np.mean(exchanged) == pytest.approx(0.4, abs=0.02)
    # pupils and wavelengths are drawn as before
    np.testing.assert_array_equal(box[:, 45:], mixed[:, 45:])
    low, high = input_ranges(DOMAINS["on_axis"], 0.4).T
    assert np.all((mixed >= low) & (mixed <= high))


def test_a_population_is_the_prior_of_the_estimation():
    unit = np.random.default_rng(4).random((20_000, 46))
    eyes = population_eyes(unit[:, :45], np.full(20_000, 1.0 / 3.0))  # of -6 dpt
    found = prior_for_refraction(-6.0).to_unit(eyes)
    # cut off where ranges end; most parameters are not
    assert np.median(np.abs(found.mean(axis=0))) < 0.02
    assert np.median(found.std(axis=0)) == pytest.approx(1.0, abs=0.03)


def test_half_of_the_population_accommodates_in_the_field():
    rows = np.random.default_rng(5).random((2000, 46))
    relaxed = population_eyes(rows[:, :45], rows[:, 45])
    eyes = partly_accommodated_eyes(relaxed, np.linspace(0.0, 1.0, 2000))
    lens_mm = eyes[:, column("lens_diameter_mm")]
    is_relaxed = lens_mm == relaxed[:, column("lens_diameter_mm")]
    assert np.mean(is_relaxed) == pytest.approx(0.5, abs=0.01)
    assert lens_mm[-1] == pytest.approx(smallest_diameter_mm(relaxed)[-1])
    low, high = population_ranges(is_focused=True).T
    assert np.all((eyes >= low - 1e-9) & (eyes <= high + 1e-9))


def test_lens_labels_are_what_the_accommodating_eye_finds():
    rows = draw(Recipe("lens", 6, 6, seed=3, population_ratio=0.5), 0)
    rows[:, -1] = np.linspace(0.2, 0.8, 6)  # within what the lens can do
    for row, found in zip(rows, DOMAINS["lens"].label(rows), strict=True):
        eye = AccommodatingEye(
            EyeParameters.from_vector(row[:45]),
            pupil_diameter_mm=float(row[45]),
            keeps_conics=True,
        )
        used_dpt = eye.accommodations_at_cornea_dpt(np.array([-found[0]]))
        np.testing.assert_allclose(eye.at_cornea_dpt(used_dpt), -found[0], atol=1e-4)
        np.testing.assert_allclose(eye.changes_mm(used_dpt)[0], found[1:], atol=1e-6)


def test_field_labels_are_single_traces():
    rows = draw(Recipe("field", 4, 4, seed=3), 0)
    found = DOMAINS["field"].label(rows)
    for row, values in zip(rows, found, strict=True):
        pupil_mm, wavelength_nm, h_deg, v_deg = row[45:].tolist()
        traced = wavefront_aberrations(
            eye_surfaces(EyeParameters.from_vector(row[:45])),
            pupil_diameter_mm=pupil_mm,
            wavelength_nm=wavelength_nm,
            h_deg=h_deg,
            v_deg=v_deg,
        )
        np.testing.assert_allclose(values[:27], traced.zernike_um[1:], atol=1e-9)
        assert values[27] == pytest.approx(traced.zernike_radius_mm, abs=1e-9)
        ellipse = traced.pupil_ellipse
        matrix = [[values[30], values[31]], [values[31], values[32]]]
        np.testing.assert_allclose(
            np.linalg.eigvalsh(matrix), (ellipse.semi_minor_mm, ellipse.semi_major_mm)
        )


def test_the_ellipse_does_not_jump_where_its_axes_are_equal():
    nearly_round = np.array([[0.0, 0.0, 2.0 + 1e-9, 2.0, a] for a in (0.0, 1.5)])
    first, second = ellipse_matrix(nearly_round)
    np.testing.assert_allclose(first, second, atol=1e-8)


def test_focus_labels_are_those_of_the_accommodating_eye():
    rows = draw(Recipe("focus", 80, 80, seed=9), 0)
    found = DOMAINS["focus"].label(rows)
    for k in (0, 17, 39, 40, 79):
        eye = AccommodatingEye(
            EyeParameters.from_vector(rows[k, :45]),
            pupil_diameter_mm=rows[k, 45],
            keeps_conics=True,
        )
        used_dpt = eye.accommodations_at_cornea_dpt(-rows[k, 46:47])
        np.testing.assert_allclose(found[k], eye.changes_mm(used_dpt)[0], atol=1e-6)


def test_the_split_is_a_partition():
    eyes = np.random.default_rng(0).random((1000, 47)).astype(np.float32)
    training, validation = split(eyes, share=0.15, seed=3)
    assert 100 < len(validation) < 200
    assert sorted([*training, *validation]) == list(range(1000))


def test_an_eye_is_not_split_between_training_and_validation():
    rows = draw(Recipe("focus", 1000, 1000), 0)
    training, validation = split(rows, share=0.3, seed=3)
    eyes = [{tuple(row) for row in rows[part, :45]} for part in (training, validation)]
    assert not eyes[0] & eyes[1]
    assert 15 < len(eyes[1]) < 45
