"""Training: its optimizer by hand, exact resumption, two processes, a whole run."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from training.batches import FRESH_STEPS, Batches, load_rows
from training.checkpoint import load_checkpoint
from training.datasets import DataError, load
from training.export import export, fresh_rows, to_onnx
from training.eye_prior import squared_deviation
from training.generate import generate
from training.losses import DiscriminatorLoss
from training.models import ModelSettings, Network
from training.optimizer import Lookahead, make_optimizer, rate_factor
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
    optimizer = make_optimizer([weight], learning_rate=0.1, weight_decay=0.5)
    weight.grad = torch.zeros(1)
    optimizer.step()
    assert weight.item() == pytest.approx(2.0 * (1.0 - 0.1 * 0.5))


def test_the_pace_falls_by_a_factor_per_epoch_and_ends_at_zero():
    settings = {"n_epochs": 10, "decay_per_epoch": 0.8, "final_ratio": 0.2}
    assert rate_factor(0.0, **settings) == 1.0
    assert rate_factor(0.3, **settings) == pytest.approx(0.8**3)
    assert rate_factor(0.9, **settings) == pytest.approx(0.8**9 / 2)
    assert rate_factor(1.0, **settings) == pytest.approx(0.0)


@pytest.fixture
def stop_late(monkeypatch):
    """Train a run up to its 16th step."""

    class Stop(Exception):
        pass

    def stop(run):
        calls = []

        def pace_and_stop(*arguments, **named):
            calls.append(1)
            if len(calls) == 17:
                raise Stop
            return rate_factor(*arguments, **named)

        with monkeypatch.context() as patch, pytest.raises(Stop):
            patch.setattr("training.train.CHECKPOINT_SECONDS", 0.0)
            patch.setattr("training.train.rate_factor", pace_and_stop)
            train(run)
        assert load_checkpoint(run.output_folder / CHECKPOINT)[1]["step"] == 16

    return stop


def _log(run):
    lines = (run.output_folder / LOG).read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_an_interrupted_training_ends_with_the_same_weights(folder, stop_late):
    whole, stopped = _run(folder, "whole"), _run(folder, "stopped")
    train(whole)
    stop_late(stopped)
    train(stopped)
    ends = [load_checkpoint(r.output_folder / CHECKPOINT)[0] for r in (whole, stopped)]
    for one, other in zip(*(e.state_dict().values() for e in ends), strict=True):
        assert torch.equal(one, other)
    logs = [_log(run) for run in (whole, stopped)]
    for entry in (*logs[0], *logs[1]):
        del entry["seconds"]
    assert logs[0] == logs[1]


def test_a_finished_training_is_left_alone(folder):
    run = _run(folder, "finished")
    entry = train(run)
    before = (run.output_folder / CHECKPOINT).read_bytes()
    assert train(run) == entry != {}
    assert (run.output_folder / CHECKPOINT).read_bytes() == before


def test_what_was_logged_after_a_checkpoint_is_dropped(folder, stop_late):
    run = _run(folder, "crashed")
    stop_late(run)
    with (run.output_folder / LOG).open("a") as log:
        log.write(json.dumps({"step": 17}) + "\n")
    train(run)
    assert [entry["step"] for entry in _log(run)] == [13, 26]


def test_a_training_goes_on_with_as_many_processes(folder, stop_late, monkeypatch):
    def two_processes():
        return 0, 2, torch.device("cpu")

    run = _run(folder, "alone")
    stop_late(run)
    monkeypatch.setattr("training.train._join", two_processes)
    with pytest.raises(RunFileError, match=r"128 rows per step.*got 256"):
        train(run)


def test_data_of_another_recipe_are_refused(folder):
    run = _run(folder, "other")
    other = replace(run, recipe=replace(run.recipe, population_ratio=0.5))
    with pytest.raises(
        DataError, match=r"population_ratio=0\.0.*population_ratio=0\.5"
    ):
        train(other)


def test_more_processes_than_rows_are_refused(folder):
    run = _run(folder, "many")
    rows = load_rows(run, run.data_folder)
    with pytest.raises(DataError, match="a step of 100 processes requires 12800"):
        Batches(rows, run, rank=0, n_ranks=100, device=torch.device("cpu"))


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
    entries = _log(run)
    assert [round(entry["epoch"]) for entry in entries] == list(range(1, 9))
    assert entries[0]["rows"] == entries[0]["step"] * 256
    assert entries[-1]["error"] < 0.95 * entries[0]["error"]


def test_fresh_rows_are_traced_for_every_step(folder):
    run = _run(folder, "fresh", n_epochs=1, more="is_fresh = true\n")
    entry = train(run)
    assert entry["error"] < 2.0
    rows = load_rows(run, run.data_folder)
    batches = Batches(rows, run, rank=0, n_ranks=1, device=torch.device("cpu"))
    first, again, other = batches.at(0)[0], batches.at(0)[0], batches.at(1)[0]
    assert torch.equal(first, again)
    known = load(run.data_folder).inputs
    for row in (first[0], other[0]):
        assert not np.any(np.all(known == row.numpy(), axis=1))
    steps = [batches.at(step)[0] for step in range(FRESH_STEPS + 2)]
    assert len({tuple(x[0].tolist()) for x in steps}) == len(steps)
    assert all(120 < len(x) <= 128 for x in steps)  # some rows let no light pass


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
    losses_um = [entry["loss"] for entry in _log(run)]
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


def test_an_unfinished_network_is_not_exported(folder, tmp_path, monkeypatch):
    run = _run(folder, "unfinished", n_epochs=1)
    train(run)
    file = run.output_folder / CHECKPOINT
    state = torch.load(file, weights_only=True)
    torch.save(state | {"step": 5}, file)
    with pytest.raises(DataError, match="step 5 of 13"):
        export(run, tmp_path, is_half=False)


def test_a_file_that_is_no_copy_of_its_network_leaves_the_old_one(
    folder, tmp_path, monkeypatch
):
    run = _run(folder, "copied", n_epochs=1)
    train(run)
    export(run, tmp_path, is_half=True, n_rows=100)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    assert set(before) == {"discriminator.onnx", "discriminator.json"}
    monkeypatch.setattr("training.export.LARGEST_PARITY_RATIO", 1e-9)
    with pytest.raises(DataError, match="differs from the trained one"):
        export(run, tmp_path, is_half=True, n_rows=100)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_only_layers_are_halved():
    settings = ModelSettings(width=32, features="physical", baseline="quadratic")
    network = Network("discriminator", n_inputs=47, n_outputs=27, settings=settings)
    model = onnx.load_from_string(to_onnx(network.eval(), n_inputs=47, half=True))
    halved = [
        tensor.name
        for tensor in model.graph.initializer
        if tensor.data_type == onnx.TensorProto.FLOAT16
    ]
    assert len(halved) > 20
    assert all(name.startswith("layers.") for name in halved)


def test_an_estimated_eye_is_judged_by_its_light():
    x, y = fresh_rows(TASKS["eye"], 20)
    own_um = misfit_of_eyes(y[:, :45].astype(float), x.astype(float))
    assert np.abs(own_um).max() < 1e-4  # eyes and wavefronts are kept in 32 bits
    shifted = y[:, :45].astype(float)
    shifted[:, 0] += 0.1  # mm of eye length: a quarter of a diopter
    moved_um = misfit_of_eyes(shifted, x.astype(float))[:, 1]
    radius_mm = x[:, -2] / 2
    moved_dpt = -4 * np.sqrt(3) * moved_um / radius_mm**2
    assert np.all((moved_dpt < -0.15) & (moved_dpt > -0.4))
