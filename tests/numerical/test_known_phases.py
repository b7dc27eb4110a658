"""Phases of fields that were asked for before are not computed again."""

import pickle

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.field.peripheral_residual import MAX_KNOWN, PeripheralResidual
from estimator.periphery.change import peripheral_change
from estimator.profiles.parse import parse_profile
from filter_service.psfs.store_file import pack, unpack

NODES_DEG = np.linspace(-20.0, 20.0, 5), np.linspace(-10.0, 10.0, 3)
H_DEG, V_DEG = np.array([-15.0, 0.0, 8.0]), np.array([3.0, 0.0, -4.0])


@pytest.fixture(scope="module")
def residual():
    profile = parse_profile({"kind": "prescription", "sphere_dpt": -2.0})
    eye = estimate_eye(profile)
    return PeripheralResidual(peripheral_change(profile), eye, NODES_DEG)


def test_equal_fields_have_the_same_phase(residual, monkeypatch):
    first_um = residual.at(H_DEG, V_DEG)
    fresh_um = pickle.loads(pickle.dumps(residual)).at(H_DEG, V_DEG)
    np.testing.assert_array_equal(fresh_um, first_um)
    monkeypatch.setattr(residual, "_difference_um", None)
    assert residual.at(H_DEG.copy(), V_DEG.copy()) is first_um


def test_few_phases_are_kept_and_none_are_pickled(residual):
    empty_bytes = len(pickle.dumps(residual))
    for k in range(2 * MAX_KNOWN):
        residual.at(H_DEG + k, V_DEG)
    assert len(residual._known_um) == MAX_KNOWN
    assert len(pickle.dumps(residual)) == pytest.approx(empty_bytes, rel=0.01)
    tree, arrays = pack(residual)  # for the cache on disk
    np.testing.assert_array_equal(
        unpack(tree, arrays).at(H_DEG, V_DEG), residual.at(H_DEG, V_DEG)
    )
    with pytest.raises(ValueError, match="read-only"):
        residual.at(H_DEG, V_DEG)[0] = 0.0
