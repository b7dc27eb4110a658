"""Names of frames: their order, how they meet, and folders without any."""

import unicodedata

import numpy as np
import pytest

from clients.batch.datasets import in_order
from clients.batch.layouts import list_frames
from clients.batch.source import FieldOfView, read_states
from tests.unit.test_batch_layouts import (
    FOV,
    write_color,
    write_integers,
    write_scene,
    write_video,
)


def test_frames_are_in_the_order_in_which_people_count(tmp_path):
    for k in range(1, 13):
        write_color(tmp_path / f"color/{k}.png")
        write_integers(tmp_path / f"depth/{k}.png", [[1, 2, 3, 4]] * 2)
    _, frames = list_frames(tmp_path, "auto", **FOV)
    assert [frame.name for frame in frames] == [str(k) for k in range(1, 13)]
    assert all(frame.color.stem == frame.depth.stem for frame in frames)


@pytest.mark.parametrize(
    "names",
    [
        ["a2", "a10", "b1"],
        ["1", "1_2", "1_10", "2", "007", "10"],
        ["1341846313.25", "1341846313.5", "1341846314.0"],
        ["take 2 frame 9", "take 2 frame 10", "take 10 frame 1"],
        ["frame", "frame1", "frame01", "frame2"],
        ["9" * 200, "1" + "0" * 200],
    ],
)
def test_numbers_in_names_count(names, rng):
    shuffled = [names[k] for k in rng.permutation(len(names))]
    found = in_order(shuffled)
    assert sorted(found) == sorted(names)
    if names[1] == "frame1":  # of equal numbers, text decides
        assert found == ["frame", "frame01", "frame1", "frame2"]
    else:
        assert found == names


def test_depth_of_a_video_is_in_the_order_of_its_frames(tmp_path):
    colors = [np.full((32, 48, 3), 10 * k, np.uint8) for k in range(12)]
    write_video(tmp_path / "c.mkv", colors, "ffv1", "bgr0", "rgb24")
    for k in range(12):
        write_integers(tmp_path / f"depth/{k}.png", np.full((32, 48), 1000 + k))
    told = tmp_path / "depth", FieldOfView(40.0)
    _, frames = list_frames(tmp_path / "c.mkv", "auto", *told)
    assert [frame.depth.name for frame in frames] == [f"{k}.png" for k in range(12)]


def test_scenes_are_in_the_order_in_which_people_count(tmp_path):
    for k in (1, 10, 2):
        write_scene(tmp_path / f"scene{k}")
    _, frames = list_frames(tmp_path, "auto")
    assert [frame.name for frame in frames] == ["scene1", "scene2", "scene10"]


def test_accents_of_macos_and_linux_meet(tmp_path):
    """A letter with an accent is one character or two, as the system stores it."""
    one, two = (unicodedata.normalize(form, "größe") for form in ("NFC", "NFD"))
    assert one != two
    write_color(tmp_path / f"color/{one}.png")
    write_integers(tmp_path / f"depth/{two}.png", [[1, 2, 3, 4]] * 2)
    _, (frame,) = list_frames(tmp_path, "auto", **FOV)
    assert frame.fault is None
    assert frame.name == one
    path = tmp_path / "states.csv"
    path.write_text(f"frame,pupil_mm\n{two},5\n")
    states = read_states(path, [frame.name])
    assert states == {frame.name: (5.0, None)}


def test_two_forms_of_a_name_in_one_folder_are_refused(tmp_path):
    for form in ("NFC", "NFD"):
        name = unicodedata.normalize(form, "größe")
        write_color(tmp_path / f"color/{name}.png")
    write_integers(tmp_path / "depth/a.png", [[1, 2, 3, 4]] * 2)
    with pytest.raises(ValueError, match="have the same name 'größe'"):
        list_frames(tmp_path, "auto", **FOV)


@pytest.mark.parametrize("folders", [("RGB", "Depth"), ("Color", "DEPTH")])
def test_folders_and_suffixes_may_have_any_case(tmp_path, folders):
    write_color(tmp_path / folders[0] / "1.JPG")
    write_integers(tmp_path / folders[1] / "1.PNG", [[1, 2, 3, 4]] * 2)
    layout, (frame,) = list_frames(tmp_path, "auto", **FOV)
    assert (layout, frame.name, frame.fault) == ("pairs", "1", None)
    depth = frame.depth_form.read(frame.depth)
    assert depth.pixels.shape == (2, 4)


def test_a_folder_without_frames_is_refused_with_its_kinds_of_files(tmp_path):
    for folder in ("color", "depth"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "1.heic").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"files: \.heic; allowed: images \(\.png, "):
        list_frames(tmp_path, "auto", **FOV)
