"""The commands of the training: errors in one line, which names what is at fault."""

import pytest

from training import evaluate, export, generate, train

WRONG = """
task = "focus"
[data]
n_rows = 100
[model]
width = 8
[training]
loss = "guess"
"""


@pytest.mark.parametrize("command", [generate, train, export, evaluate])
def test_a_wrong_run_file_is_one_line_and_exit_code_2(command, tmp_path, capsys):
    file = tmp_path / "wrong.toml"
    file.write_text(WRONG, encoding="utf-8")
    assert command.main([str(file)]) == 2
    said = capsys.readouterr().err
    name = command.__name__.removeprefix("training.")
    assert said.startswith(f"{name}: ")
    assert said.count("\n") == 1
    assert "guess" in said


@pytest.mark.parametrize("command", [train, export, evaluate])
def test_what_is_not_there_is_named(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "untrained.toml"
    file.write_text(WRONG.replace("guess", "standard"), encoding="utf-8")
    assert command.main([str(file)]) == 2
    assert "out/training" in capsys.readouterr().err
