"""`ocufilter estimate` as a person runs it."""

import json

import numpy as np
import pytest
from PIL import Image

from estimator.eye.parameters import PARAMETER_NAMES
from tests.end_to_end.test_cli import refusal, run, run_json


def test_estimate_prints_the_eye_its_coefficients_and_its_error():
    found = run_json("estimate", "astigmatism")
    assert tuple(found["parameters"]) == PARAMETER_NAMES
    assert len(found["zernike_um"]) == len(found["residual_um"]) == 28
    assert found["zernike_radius_mm"] == 2.5
    assert found["wavelength_nm"] == 587.56
    error_um = np.mean(np.abs(found["residual_um"][3:]))
    assert found["mean_abs_error_um"] <= 5e-4
    assert abs(error_um - found["mean_abs_error_um"]) < 1e-12
    assert found["time_ms"] > 0.0
    assert set(found["determined_ratio"]) == set(PARAMETER_NAMES)
    assert found["on_bound"] == []


def test_estimated_parameters_are_a_profile_of_their_own(tmp_path):
    found = run_json("estimate", "keratoconus")
    path = tmp_path / "eye.json"
    note = {"code": "file_comments", "text": "comments without effect: 'a'"}
    body = {"kind": "eye", "parameters": found["parameters"], "notes": [note]}
    path.write_text(json.dumps(body))
    again = run_json("estimate", path)
    assert again["notes"][-1] == note["text"]
    assert again["method"] == "given"
    assert again["parameters"] == found["parameters"]
    assert abs(again["refraction_dpt"] - found["refraction_dpt"]) < 1.0  # other pupil


@pytest.mark.long("an eye is estimated and drawn")
def test_plot_is_a_picture_with_a_report(tmp_path):
    path = tmp_path / "eye.png"
    finished = run("estimate", "myopia", "--plot", path)
    assert finished.returncode == 0, finished.stderr
    assert "eye_length_mm" in finished.stdout
    assert "refraction -6" in finished.stdout
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert min(pixels.shape[:2]) > 300
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 10


def test_the_network_answers_and_is_judged_by_tracing():
    found = run_json("estimate", "myopia", "--method", "network")
    assert found["method"] == "network"
    assert found["n_evaluations"] == 1
    error_um = np.mean(np.abs(found["residual_um"][3:]))
    assert found["mean_abs_error_um"] == pytest.approx(error_um, rel=1e-9)
    refined = run_json("estimate", "myopia", "--method", "refined")
    assert refined["start"] in ("table", "network")
    assert refined["mean_abs_error_um"] < found["mean_abs_error_um"]


def test_beyond_the_network_s_training_the_eye_is_refined_with_a_note(tmp_path):
    path = tmp_path / "far.json"
    path.write_text(json.dumps({"kind": "prescription", "sphere_dpt": -25}))
    found = run_json("estimate", path, "--method", "network")
    assert found["method"] == "refined"
    assert found["start"] == "table"
    assert any("zernike_j4_um" in note for note in found["notes"])


@pytest.mark.long("a search is given 0.5 s")
def test_search_stops_when_told():
    found = run_json("estimate", "myopia", "--method", "search", "--max-time-s", "0.5")
    assert found["method"] == "search"
    assert found["n_evaluations"] > 90


def test_estimate_refuses_what_it_does_not_know(tmp_path):
    assert "kerataconus" in refusal("estimate", "kerataconus")
    assert "network" in refusal("estimate", "myopia", "--method", "guess")
    assert "--max-time-s" in refusal("estimate", "myopia", "--max-time-s", "0")
    assert "png" in refusal("estimate", "myopia", "--plot", tmp_path / "eye.pdf")
