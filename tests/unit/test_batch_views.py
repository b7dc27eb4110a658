"""Distances, pupils, foci and drawn persons of a batch."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from clients.batch.layouts import list_frames
from clients.batch.profiles import drawn_people
from clients.batch.source import Constant, FieldOfView, SourceFrame, States
from clients.batch.views import Views
from clients.batch.work import batch_settings
from estimator import parse_profile
from filter_service.image_files import read_color, read_color_file
from tests.commands import run_command

OPTICS = FieldOfView(5.0)
PERSON = {"kind": "prescription", "sphere_dpt": -1.0}


def frames_of(*names):
    return [SourceFrame(name, None, None, OPTICS, Constant(0.0)) for name in names]


def test_one_view_leaves_names_as_they_are():
    views = Views.of("4", "3", "center")
    frames, states = views.of_frames(frames_of("a", "b"))
    assert [frame.name for frame in frames] == ["a", "b"]
    assert states == States(3.0, 0.25)
    assert Views.of(None, "3", "center").of_frames(frames)[1] == States(3.0, None)


def test_several_views_are_all_combinations_in_folders_of_their_values():
    views = Views.of("4,inf", "3,5.5", "0,center")
    frames, states = views.of_frames(frames_of("a", "b"))
    assert views.count == 8
    assert len({frame.name for frame in frames}) == 16
    frame = next(
        frame for frame in frames if frame.name == "distance4m_pupil5.5mm_focuscenter/b"
    )
    assert frame.depth_form == Constant(0.25)
    depth_m = np.full((10, 10), 4.0, np.float32)
    assert states.of(frame.name, depth_m) == (5.5, 0.25)
    assert states.of("distanceinfm_pupil3mm_focus0dpt/a", depth_m) == (3.0, 0.0)
    assert states.pupil_range_mm == (3.0, 5.5)
    assert states.focus_range_dpt == (0.0, 0.25)
    _, states = Views.of(None, "3", "1,center").of_frames(frames_of("a"))
    assert states.focus_range_dpt == (0.0, 10.0)  # of depth at the center


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("4", "3,12", "0"), "--pupil-mm is 12; allowed: 0.5 to 9"),
        (("4", "3,3", "0"), "'3,3'; allowed: each value once"),
        (("4", "3,", "0"), "--pupil-mm is '3,'; allowed: a number"),
        (("inf:1:1", "3", "0"), "--distance-m is 'inf:1:1'; allowed: numbers"),
        (("4", "3mm", "0"), "without 'mm', as in 3"),
        (("0.01", "3", "0"), "--distance-m is 0.01; allowed: 0.05 to inf"),
        (("4", "3", "near"), "--focus-dpt is 'near'; allowed: a number"),
        (("4", "3", "0,30"), "--focus-dpt is 30; allowed: 0 to 20"),
        (("nan", "3", "0"), "--distance-m is nan"),
    ],
)
def test_a_value_that_is_not_allowed_is_named(given, words):
    with pytest.raises(ValueError, match="--") as caught:
        Views.of(*given)
    assert words in str(caught.value)


def test_settings_have_the_distances_alone_as_planes():
    states = States(4.0, 0.0)
    assert batch_settings({}, states, (2.5, 0.25)).object_planes_dpt == (0.25, 2.5)
    many = batch_settings({}, states, (0.0, 1.0, 2.0, 3.0, 12.0))
    assert (many.object_planes_dpt, many.object_range_dpt) == ((), (0.0, 12.0))
    given = {"object_range_dpt": (0.0, 5.0)}
    assert batch_settings(given, states, (0.25,)).object_range_dpt == (0.0, 5.0)


def test_people_are_the_same_under_the_same_number():
    people = drawn_people({"me": PERSON}, 3, 9)
    assert list(people) == ["me_09", "me_10", "me_11"]
    assert people["me_10"] == PERSON | {"sample": 10}
    assert parse_profile(people["me_10"]).sample == 10
    assert drawn_people({"me": PERSON}, 2, 10)["me_10"] == people["me_10"]


@pytest.mark.parametrize(
    ("profiles", "count", "first", "words"),
    [
        ({"n": {"kind": "published", "name": "arizona"}}, 2, 0, "nothing to draw"),
        ({"n": PERSON}, 1001, 0, "people is 1001; allowed: 2 to 1000"),
        ({"n": PERSON}, 20, 999_990, "up to 999980"),
        ({"n": PERSON, "n_1": PERSON}, 2, 0, "not unique"),
    ],
)
def test_people_who_cannot_be_drawn_are_refused(profiles, count, first, words):
    with pytest.raises(ValueError, match="pe") as caught:
        drawn_people(profiles, count, first)
    assert words in str(caught.value)


@pytest.fixture
def photographs(tmp_path, rng):
    """A folder of color alone."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for name in ("a", "b"):
        color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        Image.fromarray(color).save(folder / f"{name}.png")
    return folder


def test_a_folder_without_depth_has_the_distance_that_is_given(photographs):
    layout, frames = list_frames(
        photographs, "auto", optics=OPTICS, constant=Constant(0.5)
    )
    assert layout == "pairs"
    assert [(frame.name, frame.depth) for frame in frames] == [("a", None), ("b", None)]
    color = read_color_file(frames[0].color)
    depth_m = frames[0].depth_form.like(color).pixels
    assert depth_m.shape == (24, 32)
    assert (depth_m == 2.0).all()
    assert math.isinf(Constant(0.0).like(color).pixels[0, 0])
    assert frames[0].files == (photographs / "a.png",)
    assert "Infinity" not in json.dumps(frames[0].described())


def test_a_video_needs_no_depth_if_its_distance_is_given(tmp_path, rng):
    av = pytest.importorskip("av")
    path = tmp_path / "walk.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "bgr0"
        for _ in range(2):
            color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
            image = av.VideoFrame.from_ndarray(color, format="rgb24")
            container.mux(stream.encode(image))
        container.mux(stream.encode(None))
    layout, frames = list_frames(path, "auto", optics=OPTICS, constant=Constant(0.5))
    assert (layout, len(frames)) == ("video", 2)
    assert [(frame.depth, frame.videos) for frame in frames] == [(None, (path,))] * 2
    with pytest.raises(ValueError, match=r"--depth is not given; .*or --distance-m"):
        list_frames(path, "auto", optics=OPTICS)


def test_depth_and_a_distance_are_not_both_taken(photographs):
    with pytest.raises(ValueError, match="--distance-m and --depth-scale are given"):
        list_frames(photographs, "auto", None, OPTICS, 0.001, Constant(0.5))


@pytest.mark.clients
@pytest.mark.long("eyes of two persons are prepared by a worker")
def test_one_command_filters_photographs_through_people_and_pupils(
    photographs, tmp_path
):
    out = tmp_path / "out"
    settings = '{"mode": "on-axis"}'
    arguments = (
        *("batch", photographs, "-p", json.dumps(PERSON), "--people", 2),
        *("--distance-m", 2, "--pupil-mm", "3,6", "--focus-dpt", "center"),
        *("--fov-deg", 5, "--settings", settings, "--workers", 1, "-o", out),
    )
    finished = run_command(*arguments)
    assert finished.returncode == 0, finished.stderr
    assert "8 of 8 images" in finished.stdout
    assert "2 profiles" in finished.stderr
    assert "profile_0," not in finished.stderr
    wide, narrow = (
        read_color(out / f"profile_0/pupil{mm}mm/a.png").astype(int) for mm in (6, 3)
    )
    other = read_color(out / "profile_1/pupil6mm/a.png").astype(int)
    original = read_color(photographs / "a.png").astype(int)
    assert np.abs(wide - original).mean() > np.abs(narrow - original).mean()
    assert np.abs(wide - other).max() > 0
    finished = run_command(*arguments)  # resumes: nothing is missing
    assert "8 of 8 images, 0 of them in this run" in finished.stdout


def test_a_range_is_the_list_of_its_numbers():
    assert Views.of("inf,1:3:1", "3:5:1", "0:1:0.5,center") == Views.of(
        "inf,1,2,3", "3,4,5", "0,0.5,1,center"
    )
