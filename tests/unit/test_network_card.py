"""Cards of the networks: their columns, what they refuse, what is outside of them."""

import json

import numpy as np
import pytest

from estimator.estimate.problem import FIRST_COMPARED
from estimator.eye.parameters import PARAMETER_NAMES
from estimator.networks import inference as network_card
from estimator.networks import inference as networks
from estimator.networks.inference import (
    INPUTS,
    NETWORK_NAMES,
    OUTPUTS,
    DamagedWeights,
    OutOfDomain,
    WeightsMissing,
    parse_card,
    read_card,
)


def card_json(name="focus", **changes):
    card = {
        "network": name,
        "format": 1,
        "inputs": [{"name": c, "low": -1.0, "high": 3.0} for c in INPUTS[name]],
        "outputs": list(OUTPUTS[name]),
        "commit": "1234567",
        "n_parameters": 1000,
        "precision": "float16",
        "error": {
            **{"judge": "ray tracing", "n_samples": 500, "unit": "mm"},
            **{"mean_abs": 0.002, "p95_abs": 0.006, "by_radial_order": {"2": 0.1}},
        },
    }
    return card | changes


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder in the place of the weights."""
    folder = tmp_path / "estimator" / "networks" / "weights"
    folder.mkdir(parents=True)
    monkeypatch.setattr(network_card, "WEIGHTS_FOLDER", folder)
    networks.load_network.cache_clear()
    yield folder
    networks.load_network.cache_clear()


def test_the_columns_are_those_of_the_contract():
    assert NETWORK_NAMES == ("discriminator", "eye", "focus", "aberration")
    n_inputs = [len(INPUTS[name]) for name in NETWORK_NAMES]
    assert n_inputs == [47, 27, 47, 49]
    assert [len(OUTPUTS[name]) for name in NETWORK_NAMES] == [27, 45, 2, 33]
    assert INPUTS["eye"][0] == f"zernike_j{FIRST_COMPARED}_um"
    assert INPUTS["aberration"][-2:] == ("h_deg", "v_deg")
    assert OUTPUTS["eye"] == PARAMETER_NAMES


def test_a_card_is_read():
    card = parse_card("focus", card_json())
    assert card.low.shape == card.high.shape == (47,)
    assert card.n_parameters == 1000
    assert str(card.error) == "0.002 mm (95 % below 0.006)"
    assert card.error.by_radial_order == {2: 0.1}


def test_a_column_outside_is_named_with_its_value_and_range():
    card = parse_card("focus", card_json())
    features = np.zeros((3, 47))
    assert card.outside(features) == ()
    features[1, 46], features[2, 46], features[0, 0] = 4.0, 5.0, -1.5
    with pytest.raises(OutOfDomain) as refused:
        card.check(features)
    far, near = refused.value.excesses
    assert (far.column, far.value, far.low, far.high) == ("focus_dpt", 5.0, -1.0, 3.0)
    assert (near.column, near.value) == ("eye_length_mm", -1.5)
    text = "focus_dpt 5 (trained for -1 to 3) and 1 more"
    assert str(refused.value) == text


def test_the_ends_of_a_range_are_inside_and_nan_is_not():
    card = parse_card("focus", card_json())
    ends = np.array([np.full(47, -1.0), np.full(47, 3.0)])
    assert card.outside(ends) == ()
    ends[0, 7] = np.nan
    assert [excess.column for excess in card.outside(ends)] == [PARAMETER_NAMES[7]]


def test_a_range_of_one_value_holds_that_value_only():
    data = card_json()
    data["inputs"][45] = {"name": "pupil_diameter_mm", "low": 4.0, "high": 4.0}
    card = parse_card("focus", data)
    features = np.zeros((1, 47))
    features[0, 45] = 4.0
    assert card.outside(features) == ()
    features[0, 45] = 4.1
    assert [excess.column for excess in card.outside(features)] == ["pupil_diameter_mm"]


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"network": "eye"},
        {"outputs": ["lens_diameter_change_mm"]},
        {"inputs": card_json()["inputs"][::-1]},
        {"inputs": [{"name": c, "low": 2, "high": 1} for c in INPUTS["focus"]]},
        {"error": {}},
        {"n_parameters": "many"},
    ],
)
def test_a_card_of_another_network_or_version_is_refused(folder, change):
    (folder / "focus.json").write_text(json.dumps(card_json(**change)))
    with pytest.raises(DamagedWeights, match=r"focus\.json"):
        read_card("focus")


def test_missing_weights_are_named_with_what_to_do(folder):
    with pytest.raises(
        WeightsMissing, match=r"estimator/networks/weights/focus\.json is miss"
    ):
        networks.load_network("focus")
    (folder / "focus.json").write_text(json.dumps(card_json()))
    with pytest.raises(WeightsMissing, match=r"focus\.onnx is missing.*training\.expo"):
        networks.load_network("focus")


def test_weights_that_are_no_network_are_refused(folder):
    (folder / "focus.json").write_text(json.dumps(card_json()))
    (folder / "focus.onnx").write_bytes(b"no network at all")
    with pytest.raises(DamagedWeights, match=r"focus\.onnx cannot be loaded"):
        networks.load_network("focus")
