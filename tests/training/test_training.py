"""Training: its optimiser by hand, exact resumption, two processes, a whole run."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from training.batches import load_rows
from training.checkpoint import load_checkpoint
from training.datasets import load
from training.export import export, fresh_rows
from training.eye_prior import squared_deviation
from training.generate import generate
from training.losses import DiscriminatorLoss
from training.optimiser import Lookahead, make_optimiser, pace
from training.run_file import RunFileError, read_run
from training.tasks import TASKS
from training.train import CHECKPOINT, LOG, train
from training.validation import misfit_of_eyes

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "training" / "runs" / "smoke.toml"
TINY = """
task = "{task}"
output_folder = "{folder}/{name}"
[data]
folder = "{folder}/data"
n_rows = 2000
rows_per_shard = 2000
[model]
width = 16
n_stacks = 1
features = "physical"
[training]
batch_size = 128
n_epochs = {n_epochs}
learning_rate = 0.01
"""


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def _run(folder, name, *, task="discriminator", n_epochs=2, more=""):
    file = folder / f"{name}.toml"
    text = TINY.format(task=task, folder=folder, name=name, n_epochs=n_epochs)
    file.write_text(text + more)
    return read_run(file)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    run = _run(folder, "first")
    generate(run.recipe, run.data_folder)
    return folder


def test_slow_weights_follow_the_fast_ones():
    weight = torch.nn.Parameter(torch.tensor([1.0]))
    ahead = Lookahead(torch.optim.SGD([weight], lr=0.1), n_steps=5, share=0.8)
    for _ in range(5):
        ahead.zero_grad()
        weight.sum().backward()
        ahead.step()
    # five steps of 0.1 lead to 0.5; four fifths of that way remain
    assert weight.item() == pytest.approx(1.0 - 0.8 * 0.5)


def test_weight_decay_is_decoupled():
    weight = torch.nn.Parameter(torch.tensor([2.0]))
    optimiser = make_optimiser([weight], learning_rate=0.1, weight_decay=0.5)
    weight.grad = torch.zeros(1)
    optimiser.step()
    assert weight.item() == pytest.approx(2.0 * (1.0 - 0.1 * 0.5))


def test_the_pace_falls_by_a_factor_per_epoch_and_ends_at_zero():
    settings = {"n_epochs": 10, "decay_per_epoch": 0.8, "final_ratio": 0.2}
    assert pace(0.0, **settings) == 1.0
    assert pace(0.3, **settings) == pytest.approx(0.8**3)
    assert pace(0.9, **settings) == pytest.approx(0.8**9 / 2)
    assert pace(1.0, **settings) == pytest.approx(0.0)


def test_an_interrupted_training_ends_with_the_same_weights(folder, monkeypatch):
    whole, stopped = _run(folder, "whole"), _run(folder, "stopped")
    train(whole)

    class Stop(Exception):
        pass

    calls = []

    def stop_late(*arguments, **named):
        calls.append(1)
        if len(calls) == 17:
            raise Stop
        return pace(*arguments, **named)

    monkeypatch.setattr("training.train.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("training.train.pace", stop_late)
    with pytest.raises(Stop):
        train(stopped)
    assert load_checkpoint(stopped.output_folder / CHECKPOINT)[1]["step"] == 16
    monkeypatch.setattr("training.train.pace", pace)
    train(stopped)
    ends = [load_checkpoint(r.output_folder / CHECKPOINT)[0] for r in (whole, stopped)]
    for one, other in zip(*(e.state_dict().values() for e in ends), strict=True):
        assert torch.equal(one, other)


def test_two_processes_agree_and_learn(folder):
    run = _run(folder, "two", n_epochs=8)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    for module in ("training.generate", "training.train"):
        subprocess.run(
            [
                sys.executable,
                "-m",
                "torch.distributed.run",
                "--standalone",
                "--nproc-per-node",
                "2",
                "-m",
                module,
                str(folder / "two.toml"),
            ],
            env=environment,
            check=True,
            capture_output=True,
            timeout=240,
            cwd=ROOT,
        )
    lines = (run.output_folder / LOG).read_text().splitlines()
    entries = [json.loads(line) for line in lines]
    assert [round(entry["epoch"]) for entry in entries] == list(range(1, 9))
    assert entries[0]["rows"] == entries[0]["step"] * 256
    assert entries[-1]["error"] < 0.95 * entries[0]["error"]


def test_fresh_rows_are_traced_for_every_step(folder):
    run = _run(folder, "fresh", n_epochs=1, more="is_fresh = true\n")
    entry = train(run)
    assert entry["error"] < 2.0
    from training.batches import Batches, load_rows

    rows = load_rows(run, run.data_folder)
    batches = Batches(rows, run, rank=0, n_ranks=1, device=torch.device("cpu"))
    first, again, other = batches.at(0)[0], batches.at(0)[0], batches.at(1)[0]
    assert torch.equal(first, again)
    known = load(run.data_folder).inputs
    for row in (first[0], other[0]):
        assert not np.any(np.all(known == row.numpy(), axis=1))
    assert not torch.equal(first[0], other[0])


def _network_and_rows(run):
    network, _ = load_checkpoint(run.output_folder / CHECKPOINT)
    return network, load_rows(run, run.data_folder).validation


def test_the_eye_learns_through_a_discriminator(folder):
    judge = _run(folder, "judge", n_epochs=8)
    train(judge)
    checkpoint = judge.output_folder / CHECKPOINT
    more = f'loss = "discriminator"\ndiscriminator = "{checkpoint}"\n'
    run = _run(folder, "eye", task="eye", n_epochs=20, more=more)
    train(run)
    lines = (run.output_folder / LOG).read_text().splitlines()
    losses_um = [json.loads(line)["loss"] for line in lines]
    assert losses_um[-1] < 0.9 * losses_um[0]
    judge = load_checkpoint(checkpoint)[0]
    loss, with_prior = (
        DiscriminatorLoss(judge),
        DiscriminatorLoss(judge, prior_weight=1),
    )
    network, (x, y) = _network_and_rows(run)
    with torch.no_grad():
        deviation = squared_deviation(network(x), x).mean().item()
        gain = (with_prior(network, x, y) - loss(network, x, y)).item()
    assert gain == pytest.approx(deviation, rel=1e-4)
    assert not any(p.requires_grad for p in loss.parameters())


def test_a_whole_run_beats_a_straight_line(tmp_path):
    """The one-minute run: generate, train, export; judged on rows traced anew."""
    run = replace(read_run(SMOKE), data_folder=tmp_path / "d", output_folder=tmp_path)
    generate(run.recipe, run.data_folder)
    train(run)
    card = export(run, tmp_path / "weights", is_half=True, n_rows=1000)
    x, y = fresh_rows(TASKS["discriminator"], 1000)
    rows = load(run.data_folder)
    with_one = [
        np.column_stack([part, np.ones(len(part))]) for part in (rows.inputs, x)
    ]
    line = np.linalg.lstsq(with_one[0], rows.targets, rcond=None)[0]
    straight = np.mean(np.abs(with_one[1] @ line - y))
    assert card["error"]["mean_abs"] < 0.75 * straight
    assert card["parity"]["max_abs"]["um"] < 0.2 * card["error"]["mean_abs"]
    assert card["bytes"] < 3 * card["n_parameters"] + 100_000


def test_a_card_is_not_written_for_another_run_file(folder, tmp_path):
    run = _run(folder, "carded", n_epochs=1)
    train(run)
    with pytest.raises(RunFileError, match="another run file"):
        export(replace(run, text=run.text + "# changed"), tmp_path, is_half=False)
    assert not list(tmp_path.iterdir())


def test_an_estimated_eye_is_judged_by_its_light():
    x, y = fresh_rows(TASKS["eye"], 20)
    own_um = misfit_of_eyes(y[:, :45].astype(float), x.astype(float))
    assert np.abs(own_um).max() < 1e-4  # eyes and wavefronts are kept in 32 bits
    shifted = y[:, :45].astype(float)
    shifted[:, 0] += 0.1  # mm of eye length: a quarter of a dioptre
    moved_um = misfit_of_eyes(shifted, x.astype(float))[:, 1]
    radius_mm = x[:, -2] / 2
    moved_dpt = -4 * np.sqrt(3) * moved_um / radius_mm**2
    assert np.all((moved_dpt < -0.15) & (moved_dpt > -0.4))
