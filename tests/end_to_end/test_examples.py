"""The examples run as a user runs them, and their pictures show what they say."""

import csv
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.end_to_end.printed_script import printed_by
from tests.source_tree import ROOT

EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(EXAMPLES.glob("[0-9]*.py"))
OUT = Path("out/examples")
PAGE = (EXAMPLES / "README.md").read_text(encoding="utf-8")
PICTURES_MB = 0.65


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run an example in a folder of its own; its picture as an array."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def run_example(name: str) -> np.ndarray:
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return picture(tmp_path / OUT / f"{name}.png")

    return run_example


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), float)


def detail(part: np.ndarray) -> float:
    """How much neighboring pixels differ: less where it is blurred."""
    return float(np.abs(np.diff(part[..., 1], axis=1)).mean())


def steepest(part: np.ndarray) -> float:
    """Return the largest step between neighboring pixels: less where edges blur."""
    return float(np.abs(np.diff(part[..., 1], axis=1)).max())


def cell(page: np.ndarray, row: int, column: int, shape) -> np.ndarray:
    """One picture of a page of `save_pictures`."""
    rows, columns = shape
    height, width = page.shape[0] / rows, (page.shape[1] + 6) / columns
    top, left = round(row * height), round(column * width)
    return page[top : top + round(height) - 26, left : left + round(width) - 6]


@pytest.mark.clients
def test_the_first_picture_by_itself_in_another_folder(tmp_path):
    said = printed_by(EXAMPLES / "01_first_picture.py", cwd=tmp_path)
    assert said.strip() == str(OUT / "01_first_picture.png")
    page = picture(tmp_path / said.strip())
    scene, seen = (cell(page, 0, column, (1, 2)) for column in (0, 1))
    assert scene.shape == (270, 480, 3)
    assert detail(seen) < 0.6 * detail(scene)


@pytest.mark.clients
def test_an_aberrometers_file_gives_points_and_a_curve(run, capsys):
    page = run("02_aberrometer_to_field")
    assert page.std() > 50.0
    said = capsys.readouterr().out
    assert re.search(r"eye of 2\d\.\d mm", said)
    assert "periphery: " in said


@pytest.mark.clients
def test_of_three_cards_the_one_looked_at_is_sharp(run):
    page = run("03_own_scene")
    far = cell(page, 1, 1, (2, 2))  # looks at 5 m
    near, far_card = far[40:160, 25:145], far[40:160, 335:455]
    assert detail(far_card) > 2.0 * detail(near)


@pytest.mark.clients
@pytest.mark.slow
def test_of_two_eyes_the_short_sighted_one_blurs_what_is_far(run):
    page = run("04_stereo")
    left, right = (cell(page, 1, column, (2, 2))[:130] for column in (0, 1))
    assert detail(right) > 1.2 * detail(left)


@pytest.mark.clients
def test_through_focus_the_card_is_sharp_where_it_hangs(run):
    page = run("05_through_focus")
    row = [detail(cell(page, 0, column, (3, 5))) for column in range(5)]
    assert np.argmax(row) == 2  # its distance, 2 dpt
    assert row[2] > 1.3 * max(row[0], row[4])


@pytest.mark.clients
@pytest.mark.slow
def test_streamed_frames_change_with_the_eye(run, capsys):
    page = run("06_streaming")
    far, near = (cell(page, k, 0, (2, 2))[:150] for k in (0, 1))
    assert detail(far) > 1.2 * detail(near)  # the house, looked at and not
    assert re.search(r"24 frames, \d+ ms each", capsys.readouterr().out)


@pytest.mark.clients
def test_the_data_set_has_its_labels(run, tmp_path):
    run("07_augment_data_set")
    folder = tmp_path / OUT / "letters"
    with (folder / "labels.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["file"] for row in rows} == {p.name for p in folder.glob("*.png")}
    assert len(rows) == 24
    assert len({row["sphere_dpt"] for row in rows}) == 6
    assert len({(folder / row["file"]).read_bytes() for row in rows}) == len(rows)


@pytest.mark.clients
def test_of_three_meshes_the_one_looked_at_is_sharp_through_two_cameras(run, capsys):
    page = run("09_pyrender")
    assert "12 frames of 3 meshes by each camera" in capsys.readouterr().out
    for row in (0, 1):
        near, far = (cell(page, row, column, (2, 3)) for column in (1, 2))
        box, ring = np.s_[40:150, 55:115], np.s_[:140, 220:]
        assert steepest(near[box]) > 1.3 * steepest(far[box])
        assert steepest(far[ring]) > 1.3 * steepest(near[ring])


@pytest.mark.clients
def test_a_mesh_of_trimesh_blurs_where_the_eye_focuses_before_it(
    run, tmp_path, monkeypatch
):
    path = tmp_path / "ring.stl"
    trimesh.creation.annulus(1.0, 2.0, 1.0).export(path)
    monkeypatch.setattr("sys.argv", ["10_trimesh.py", str(path)])
    page = run("10_trimesh")
    mesh, sharp, blurred = (cell(page, 0, column, (1, 3)) for column in (0, 1, 2))
    assert steepest(sharp) > 0.7 * steepest(mesh)
    assert steepest(blurred) < 0.7 * steepest(sharp)


@pytest.mark.clients
def test_a_card_that_was_solved_for_a_viewer_shows_more_contrast(run, capsys):
    page = run("11_correct")
    before, after = (cell(page, 1, column, (2, 3))[:60, 50:190] for column in (0, 1))
    assert detail(after) > 1.03 * detail(before)
    assert after.min() < before.min()
    said = capsys.readouterr().out
    gains = [
        float(after) - float(before)
        for before, after in re.findall(r"([\d.]+) dB before, ([\d.]+) dB after", said)
    ]
    assert 0.1 < gains[0] < gains[1] - 0.5


@pytest.mark.clients
@pytest.mark.slow
def test_a_scene_is_recovered_until_noise_prevails(run, capsys):
    page = run("12_deblur")
    scene, seen, few = (cell(page, 0, column, (2, 3)) for column in (0, 1, 2))
    many = cell(page, 1, 1, (2, 3))
    assert detail(seen) < detail(few) < detail(many)
    assert detail(scene) < detail(many)
    said = capsys.readouterr().out
    assert "PyTorch is not installed" in said or "gradients: " in said
    seen_db, few_db, some_db, many_db = map(
        float, re.findall(r"(?:noise|steps): ([\d.]+) dB", said)
    )
    assert seen_db + 1.0 < few_db < some_db > many_db + 2.0


@pytest.mark.clients
@pytest.mark.slow
def test_the_best_lens_sharpens_the_card(run, capsys):
    page = run("13_best_lens")
    before, after = (cell(page, 0, column, (2, 3)) for column in (1, 2))
    assert detail(after) > 1.5 * detail(before)
    far, both = (cell(page, 1, column, (2, 3)) for column in (1, 2))
    assert detail(far) > 1.2 * detail(both)
    said = capsys.readouterr().out
    assert re.search(r"keratoconus, far: -\d\.\d\d / -\d\.\d\d x \d+, rounded -", said)
    assert re.search(r"60 years, far and near: \+0\.\d\d, rounded \+0\.\d\d ", said)


def test_every_example_is_on_the_page_with_its_picture():
    named = re.findall(r"\[`(\d\d_\w+\.(?:py|ipynb))`\]\(\1\)", PAGE)
    files = sorted(p.name for p in EXAMPLES.glob("[0-9]*"))
    assert named == files
    assert len(SCRIPTS) == 12
    for name in files:
        assert f"](pictures/{Path(name).stem}.jpg)" in PAGE
    pictures = list((EXAMPLES / "pictures").glob("*.jpg"))
    assert len(pictures) == len(files)
    assert sum(p.stat().st_size for p in pictures) < 1e6 * PICTURES_MB
