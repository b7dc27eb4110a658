"""What each accuracy takes from networks, what falls back, and what the notes say.

The networks here trace, see `traced_networks`: their answers are perfect.
"""

import re
from typing import get_args

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.eye.parameters import column
from estimator.field import notes as eye_notes
from estimator.field import prepare
from estimator.networks.card import WeightsMissing
from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.settings import DEFAULTS, Accuracy
from tests.grid_specs import grid_spec
from tests.numerical.eye_cases import as_profile
from tests.numerical.traced_networks import (
    USERS,
    TracedNetwork,
    put_in_place,
    trace_aberrations,
    trace_focus,
)

MYOPIA = {"kind": "prescription", "sphere_dpt": -2.0, "higher_order": "none"}
SPEC = grid_spec(
    Camera(64, 48, (-0.2, 0.2, 0.15, -0.15)),
    pupil_range_mm=(4.0, 4.5),
    focus_range_dpt=(0.0, 3.0),
    mode="dynamic",
)
OFF_MM = 0.05
"""Error of the eye network's eye: its length."""


def trace_eye(row):
    """Give an eye that has a wavefront up to a defocus of some 0.15 dpt."""
    profile = as_profile(
        np.concatenate([np.zeros(3), row[:25]]),
        pupil_diameter_mm=float(row[25]),
        wavelength_nm=float(row[26]),
        name="",
    )
    vector = estimate_eye(profile, starts=("table",)).parameters.to_vector()
    vector[column("eye_length_mm")] += OFF_MM
    return vector


ASKING = (*USERS, eye_notes, prepare)


@pytest.fixture
def place(monkeypatch):
    """Put networks in place, with the ranges given by network."""
    monkeypatch.setattr("tests.numerical.traced_networks.USERS", ASKING)

    def put(eye=None, focus=None, aberration=None, eye_p95_um=0.5):
        put_in_place(
            monkeypatch,
            TracedNetwork("eye", trace_eye, eye, p95_um=eye_p95_um),
            TracedNetwork("focus", trace_focus, focus, p95_um=2e-3),
            TracedNetwork("aberration", trace_aberrations, aberration, p95_um=0.02),
        )

    return put


def prepared(accuracy, body=MYOPIA, spec=SPEC):
    return eye_for_spec(parse_profile(body), spec.with_settings(accuracy=accuracy))


def said(notes, start):
    (note,) = [note for note in notes if note.startswith(start)]
    return note


def test_fast_is_by_network_and_says_how_exact(place):
    place()
    eye, notes = prepared("fast")
    assert "by network" in said(notes, "eye ") and "expected 0.25 um" in notes[0]
    assert "by network, expected error 0.001 um" in said(notes, "focus ")
    assert "by network, expected error 0.01 um" in said(notes, "aberrations ")
    assert re.search(r"0\.\d+ um at \d traced nodes|e-\d+ um", said(notes, "aberr"))
    assert not any("not by network" in note for note in notes)
    exact, _ = prepared("exact")
    # the network's eye is 0.05 mm longer; what that spoils is added as a phase
    assert eye.refraction_dpt == pytest.approx(exact.refraction_dpt, abs=1e-3)


def test_an_eye_far_off_its_wavefront_is_refined(place):
    place(eye_p95_um=1e-3)
    _, notes = prepared("fast")
    assert "refined from a table's eye" in notes[0]
    assert "in its eye (95 % should be below 0.001)" in said(notes, "eye not by")


def test_balanced_refines_the_eye(place, monkeypatch):
    place()
    monkeypatch.setattr("estimator.field.grid_source.LEAST_GAIN_MS", 0.0)
    eye, notes = prepared("balanced")
    assert "refined from" in notes[0]
    assert float(re.search(r"error (\S+) um", notes[0])[1]) < 1e-3
    assert "focus traced" in said(notes, "focus ")
    assert "aberrations by network" in said(notes, "aberrations ")
    exact, _ = prepared("exact")
    assert eye.refraction_dpt == pytest.approx(exact.refraction_dpt, abs=1e-3)


def test_balanced_traces_what_costs_little(place, monkeypatch):
    place()
    monkeypatch.setattr("estimator.field.grid_source.LEAST_GAIN_MS", 1e9)
    _, notes = prepared("balanced")
    assert said(notes, "aberrations ").startswith("aberrations traced to about 1e-03")
    assert not any("by network" in note for note in notes)


def test_exact_asks_no_network(monkeypatch):
    put_in_place(monkeypatch)  # none: a KeyError to whom asks
    _, notes = prepared("exact")
    assert not any("network" in note for note in notes)
    assert "refined from a table's eye" in notes[0]
    assert len(notes) == 5
    assert notes[3].startswith("periphery: ")
    assert notes[4] == "prescription: -2.00 at the cornea"


@pytest.mark.parametrize("accuracy", ["fast", "balanced"])
def test_what_is_out_of_the_domain_is_traced_and_named(place, monkeypatch, accuracy):
    place(
        eye={"zernike_j4_um": (-1.0, 1.0)},
        focus={"focus_dpt": (-1.0, 1.0)},
        aberration={"h_deg": (-5.0, 5.0)},
    )
    monkeypatch.setattr("estimator.field.grid_source.LEAST_GAIN_MS", 0.0)
    eye, notes = prepared(accuracy)
    exact, _ = prepared("exact")
    assert "zernike_j4_um 2.59" in said(notes, "eye not by network")
    assert "(trained for -1 to 1)" in said(notes, "eye not by network")
    over_field = said(notes, "aberrations over the field traced")
    assert "h_deg" in over_field and "(trained for -5 to 5)" in over_field
    assert "by network" in said(notes, "aberrations on the axis")
    assert ("focus_dpt" in said(notes, "focus traced")) == (accuracy == "fast")
    assert eye.refraction_dpt == pytest.approx(exact.refraction_dpt, abs=1e-9)
    assert all(len(note.encode()) <= 200 for note in notes) and len(notes) <= 8


@pytest.mark.parametrize("accuracy", get_args(Accuracy))
def test_without_weights_everything_is_traced(monkeypatch, accuracy):
    def missing(name):
        raise WeightsMissing(f"{name}.onnx is missing")

    for module in ASKING:
        monkeypatch.setattr(module, "load_network", missing)
    eye, notes = prepared(accuracy)
    exact, _ = prepared("exact")
    assert eye.refraction_dpt == exact.refraction_dpt
    told = any("eye.onnx is missing" in note for note in notes)
    assert told == (accuracy != "exact")
    grids = any("aberration.onnx is missing" in note for note in notes)
    assert grids == (accuracy != "exact")


def test_a_given_eye_needs_no_estimate(place):
    place()
    given = estimate_eye(parse_profile(MYOPIA)).parameters.to_mapping()
    _, notes = prepared("fast", {"kind": "eye", "parameters": given})
    assert notes[0] == "eye as given by its parameters"
    assert "by network" in said(notes, "aberrations ")


def test_an_unknown_accuracy_is_refused():
    with pytest.raises(ValueError, match="balanced, exact, fast"):
        prepared("precise")
    assert DEFAULTS.accuracy in get_args(Accuracy)
