"""Table 3: rows that can be compared, and a table that is made by the command."""

import json
from pathlib import Path

import pytest

from training import learning_curve, table3
from training.checkpoint import make_network
from training.table3 import VARIANTS, make_run, variants
from training.tasks import TASKS

SIZE = {"width": 128, "rows": 1_000_000}


@pytest.mark.parametrize("task", TASKS)
def test_rows_of_a_task_have_the_same_budget(task):
    runs = [make_run(task, *row, **SIZE) for row in variants(task)]
    assert len({run.training.n_epochs for run in runs}) == 1
    assert len({run.output_folder for run in runs}) == len(runs)
    plain = [run for run in runs if run.model.baseline == "none"]
    counts = [make_network(task, run.model).n_parameters for run in plain]
    assert max(counts) < 1.06 * min(counts)


def test_the_eye_is_trained_with_each_loss():
    losses = {loss for _, _, loss, _ in variants("eye")}
    assert losses == {"parameters", "discriminator", "tracer"}


def test_the_command_trains_judges_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(table3, "DATA_ROWS", {"on_axis": 600})
    monkeypatch.setattr(table3, "VARIANTS", {k: VARIANTS[k] for k in ("ffn", "ours")})
    written = tmp_path / "table.json"
    options = "--width 8 --rows 2048 --judged-rows 200 --tasks discriminator --json"
    assert table3.main([*options.split(), str(written)]) == 0
    rows = json.loads(written.read_text())["rows"]
    assert [row["kind"] for row in rows] == ["ffn", "ours"]
    assert all(0.1 < row["error"]["mean_abs"] < 3.0 for row in rows), rows
    assert "(paper 0.070620 um)" in capsys.readouterr().out


def test_a_learning_curve_has_each_point_once(tmp_path, monkeypatch):
    assert len(learning_curve.sizes()) == len(set(learning_curve.sizes())) == 9
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(table3, "DATA_ROWS", {"lens": 1000})
    monkeypatch.setattr(learning_curve, "ROWS_SEEN", 1000)
    options = "--tasks focus --rows 1000 2000 --widths 8 --judged-rows 50"
    files = ["--json", "curve.json", "--plot", "curve.png"]
    assert learning_curve.main([*options.split(), *files]) == 0
    rows = json.loads(Path("curve.json").read_text())["rows"]
    assert [row["width"] for row in rows] == [128, 128, 8]
    # so few rows leave the quadratic form open: no paraxial lens misses by as much
    assert all(0.0 < row["error"]["mean_abs"] < 1.0 for row in rows), rows
    assert Path("curve.png").stat().st_size > 10_000
