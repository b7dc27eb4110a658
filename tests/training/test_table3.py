"""Table 3: rows that can be compared, and a table that is made by the command."""

import argparse
import json

import pytest

from training import table3
from training.checkpoint import make_network
from training.generate import generate
from training.run_file import read_run
from training.table3 import VARIANTS, make_run, variants
from training.tasks import TASKS

OPTIONS = argparse.Namespace(width=128, rows=1_000_000)


@pytest.mark.parametrize("task", TASKS)
def test_rows_of_a_task_have_the_same_budget(task):
    runs = [make_run(task, *row, OPTIONS) for row in variants(task)]
    assert len({run.training.n_epochs for run in runs}) == 1
    assert len({run.output_folder for run in runs}) == len(runs)
    plain = [run for run in runs if run.model.baseline == "none"]
    counts = [make_network(task, run.model).n_parameters for run in plain]
    assert max(counts) < 1.06 * min(counts)


def test_the_eye_is_trained_with_each_loss():
    losses = {loss for _, _, loss in variants("eye")}
    assert losses == {"parameters", "discriminator", "tracer"}


def test_the_command_trains_judges_and_writes(tmp_path, monkeypatch, capsys):
    run_file = tmp_path / "discriminator.toml"
    run_file.write_text(
        f'task = "discriminator"\n[data]\nfolder = "{tmp_path}/data"\n'
        "n_rows = 600\nrows_per_shard = 600\n[training]\nbatch_size = 64\n"
    )
    run = read_run(run_file)
    generate(run.recipe, run.data_folder)
    monkeypatch.setattr(table3, "RUNS", tmp_path)
    monkeypatch.setattr(table3, "FOLDER", tmp_path / "out")
    monkeypatch.setattr(table3, "VARIANTS", {k: VARIANTS[k] for k in ("ffn", "ours")})
    written = tmp_path / "table.json"
    options = "--width 8 --rows 2048 --judged-rows 200 --tasks discriminator --json"
    assert table3.main([*options.split(), str(written)]) == 0
    rows = json.loads(written.read_text())["rows"]
    assert [row["kind"] for row in rows] == ["ffn", "ours"]
    assert all(1600 < row["rows_seen"] < 2100 for row in rows)
    assert all(0.1 < row["error"]["mean_abs"] < 3.0 for row in rows), rows
    assert "(paper 0.070620 um)" in capsys.readouterr().out
