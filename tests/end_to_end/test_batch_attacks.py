"""`ocufilter batch` under attack: nothing lost, no false hash, identical bytes."""

import os

import pytest

from tests.batch_attacks import ATTACKS, Undisturbed, attack_once

N_RUNS = int(os.environ.get("OCUFILTER_BATCH_ATTACKS", "300"))
"""Attacks of the slow test, all kinds together."""


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return Undisturbed(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.clients
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_batch_under_attack(attack, expected, tmp_path):
    attack_once(attack, 1, tmp_path, expected)


@pytest.mark.slow
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_batch_under_many_attacks(attack, expected, tmp_path):
    for seed in range(2, 2 + -(-N_RUNS // len(ATTACKS))):
        attack_once(attack, seed, tmp_path, expected)
