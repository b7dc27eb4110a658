"""`ocufilter scenario`: the list, and the pictures of one scenario."""

import json

import numpy as np
import pytest
from PIL import Image

from clients.provenance import METADATA_KEY
from clients.scenarios import scenarios
from tests.commands import run_command


def test_scenarios_are_listed():
    listed = run_command("scenario", "--json")
    found = json.loads(listed.stdout)["scenarios"]
    assert [each["name"] for each in found] == list(scenarios())
    assert "correction" in found[0]["differing_entries"]
    shown = run_command("scenario").stdout
    assert all(
        f"{one.name} " in shown and one.title in shown for one in scenarios().values()
    )


@pytest.mark.clients
def test_a_scenario_writes_both_states(tmp_path):
    folder = tmp_path / "reading"
    answer = run_command(
        *("scenario", "reading", "-o", str(folder), "--size", "240x135", "--json")
    )
    report = json.loads(answer.stdout)
    names = ("scene", "a", "b")
    images = {n: np.asarray(Image.open(folder / f"{n}.png"), float) for n in names}
    # The addition makes the letters of the chart sharp again.
    blur = {n: np.abs(images[n] - images["scene"]).mean() for n in ("a", "b")}
    assert blur["a"] > 1.5 * blur["b"] > 0.0
    assert len(report["pictures"]) == 3
    assert report["focus_dpt"] == pytest.approx(2.5)
    assert any("accommodation stops" in note for note in report["notes"]["a"])
    metadata = json.loads(Image.open(folder / "b.png").text[METADATA_KEY])
    assert metadata["scenario"] == "reading"
    assert metadata["pupil_diameter_mm"] == 3.2


def test_an_unknown_scenario_is_refused_with_all_names(tmp_path):
    answer = run_command("scenario", "Reading", "-o", str(tmp_path / "none"))
    assert answer.returncode == 2
    assert "expected one of: astigmatism," in answer.stderr
    assert not (tmp_path / "none").exists()
    answer = run_command("scenario", "reading", "--size", "9000x9000", cwd=tmp_path)
    assert answer.returncode == 2
    assert "--size is 9000; allowed: 16 to 4096" in answer.stderr
    assert not list(tmp_path.iterdir())
