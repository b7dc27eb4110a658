"""The real renderer and the real PSFs behind the socket."""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import CHECKOUT
from filter_service import EyeFilter, FilterSettings, ViewState, errors
from filter_service.camera import tangents_from_fov
from filter_service.messages import Camera, Dropped, body_of_eye
from tests.commands import run_command
from tests.numerical.surface_bodies import RELAXED

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0, "output": "linear"}
# A narrow range of pupils and distances keeps the builds of these tests short.
NARROW = {"pupil_range_mm": (3.9, 4.1), "object_range_dpt": (0, 1)}
ON_AXIS = NARROW | {"mode": "on-axis"}
"""Where the field is not the subject."""

ONE_STATE = {"pupil_range_mm": (4.0, 4.0), "focus_range_dpt": (0.0, 0.0)}
ONE_STATE |= {"object_range_dpt": (0.5, 0.5), "tolerance": "loose"}
"""That of `SEE` and `edge_view`."""

MYOPIA = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -12}
PLAIN = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": 0}


@pytest.fixture
def real_client(real_service):
    with FilterClient(real_service.endpoint, timeout_s=10.0) as client:
        yield client


def test_the_supervisor_does_not_load_what_only_other_processes_need(
    real_service, real_client
):
    """It did when it stored a session, 10 MB."""
    assert real_client.welcome is not None
    for name, is_loaded in (("supervisor", False), ("front-end", True)):
        maps = Path(f"/proc/{real_service.pids()[name]}/maps").read_text()
        assert [library in maps for library in ("numpy", "libzmq")] == [is_loaded] * 2


def edge_view(width_px=160, height_px=90):
    """Return a white right half beside a black left half, 2 m away."""
    color = np.zeros((height_px, width_px, 3), np.float32)
    color[:, width_px // 2 :] = 1.0
    depth_m = np.full((height_px, width_px), 2.0, np.float32)
    return RgbdView(color, depth_m, tangents_from_fov(40.0, width_px, height_px))


def edge_width_px(color):
    """Return over how many columns the middle row rises from 5 % to 95 %."""
    row = color[color.shape[0] // 2, :, 1]
    return int(np.count_nonzero((row > 0.05) & (row < 0.95)))


IMPLANT = {
    "kind": "pseudophakic",
    "axial_length_mm": 23.5,
    "keratometry_dpt": [43.5, 43.5],
    "lens_center_mm": 4.9,
    "implant": {"power_dpt": 21},
}


def test_eyes_given_by_surfaces_are_filtered_and_a_blocked_one_is_refused(real_client):
    view = edge_view()
    widths_px = {}
    for name, profile in (
        ("arizona", {"kind": "published", "name": "arizona"}),
        ("gradient", {"kind": "published", "name": "atchison_2006"}),
        ("surfaces", RELAXED),
        ("implant", IMPLANT),
        ("strong implant", IMPLANT | {"implant": {"power_dpt": 30}}),
    ):
        ready = real_client.set_profile(profile, settings=ON_AXIS, views=[view])
        assert "as given by its surfaces" in " ".join(ready.notes)
        found = real_client.filter(view, **SEE | {"focus_dpt": 0.5})
        widths_px[name] = edge_width_px(found.color)
    blurred = widths_px.pop("strong implant")
    # -6.6 dpt: three columns of 0.25 deg, as a prescription of that power
    assert max(widths_px.values()) < 2 <= blurred
    blocked = [{**s, "clear_radius_mm": 0.3} for s in RELAXED["surfaces"]]
    with pytest.raises(
        errors.FilterError, match=r"surfaces\[\d\]: outside a clear radius"
    ):
        real_client.set_profile(
            RELAXED | {"surfaces": blocked}, settings=ON_AXIS, views=[view]
        )
    assert real_client.filter(view, **SEE).color.shape == view.color.shape


def test_a_myopic_eye_blurs_a_far_edge_and_a_normal_one_does_not(real_client):
    view = edge_view()
    widths_px = []
    for profile in (PLAIN, MYOPIA):
        ready = real_client.set_profile(profile, settings=ON_AXIS, views=[view])
        assert ready.psf_count > 0
        reply = real_client.filter(view, **SEE)
        widths_px.append(edge_width_px(reply.color))
        stages_ms = reply.stage_times_ms
        assert sum(stages_ms.values()) == pytest.approx(reply.total_ms)
        assert stages_ms["splat_ms"] > 0
    # About 11 dpt of defocus over 4 mm blur by 44 mrad, with 8 mrad per pixel.
    assert widths_px[0] <= 1
    assert 4 <= widths_px[1] <= 6


def test_the_code_of_a_note_does_not_depend_on_its_numbers(real_client):
    view = edge_view(32, 18)
    body = {"kind": "prescription", "sphere_dpt": -4, "vertex_mm": 12}
    ready = real_client.set_profile(body, settings=NARROW, views=[view])
    codes = [detail.code for detail in ready.note_details]
    assert len(codes) == len(ready.notes)
    assert {"focus_accuracy", "typical_aberrations", "plane_of_powers"} < {*codes}
    assert "other" not in codes
    headers = [
        real_client.filter(view, **SEE | {"focus_dpt": focus_dpt})
        for focus_dpt in np.linspace(0.0, 3.0, 35)
    ]
    assert len({header.notes for header in headers}) == 35
    assert {d.code for h in headers for d in h.note_details} == {
        "focus_beyond_far_point"
    }
    values = headers[7].note_details[0].values
    assert values["focus_dpt"] == pytest.approx(7 * 3.0 / 34)
    assert values["far_point_dpt"] == pytest.approx(3.76, abs=0.2)


def test_a_hidden_layer_is_seen_past_a_blurred_edge(real_client):
    seen = edge_view()
    near = np.arange(160)[None, :] >= 80
    depth_m = np.broadcast_to(np.where(near, 0.1, np.inf), (90, 160))
    seen = replace(seen, depth_m=depth_m.astype(np.float32))
    hidden_m = np.broadcast_to(np.where(near, np.inf, 0.0), (90, 160))
    layered = replace(
        seen,
        hidden_color=np.zeros_like(seen.color),
        hidden_depth_m=hidden_m.astype(np.float32),
    )
    settings = ON_AXIS | {"object_range_dpt": (0, 10)}
    real_client.set_profile(PLAIN, settings=settings, views=[seen])
    one, two = real_client.filter([seen, layered], **SEE).colors
    # 10 dpt over 4 mm blur by 2.5 px; 1.5 px inside the edge the near white covers all
    # of the pupil but a segment, where it is alone or lets the dark behind it through.
    t = 0.6
    share = (np.arccos(t) - t * np.sqrt(1 - t**2)) / np.pi
    assert one[45, 81, 1] > 0.98
    assert two[45, 81, 1] == pytest.approx(1 - share, abs=0.03)
    np.testing.assert_allclose(one[45, 120:140], two[45, 120:140], atol=1e-3)


@pytest.mark.long("a process starts and renders a scene")
def test_a_scene_streams_with_what_it_hides(real_service):
    arguments = ("--scene", "primitives", "--profile", "emmetropia", "--hidden")
    finished = subprocess.run(
        [
            *(sys.executable, "-W", "error", "-m", "clients.pyrender_stream"),
            *("--endpoint", real_service.endpoint, *arguments),
            *("--size", "96x54", "--frames", "3", "--json", "--natural"),
        ],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert report["sent"] == 3
    assert report["frames"] + sum(report["drops"].values()) == 3
    assert report["frames"] >= 1


def test_one_profile_sent_twice_and_two_views_work(real_client):
    view = edge_view()
    settings = ON_AXIS | {"prepare": "ranges"}  # the same again
    colors = []
    for _ in range(2):
        real_client.set_profile(MYOPIA, settings=settings, views=[view])
        reply = real_client.filter([view, view], **SEE)
        assert len(reply.colors) == 2
        colors += reply.colors
    for color in colors[1:]:
        np.testing.assert_array_equal(color, colors[0])


@pytest.mark.long("four eyes are traced and computed")
def test_two_eyes_see_what_each_sees_alone_in_this_process(real_client):
    """An asymmetric pair through two profiles, two pupils and two gazes."""
    left_tangents, right_tangents = (-0.5, 0.3, 0.3, -0.4), (-0.3, 0.5, 0.3, -0.4)
    view = edge_view(120, 100)
    left = replace(view, tangents=left_tangents)
    right = replace(view, tangents=right_tangents, color=view.color[:, ::-1].copy())
    settings = {
        "pupil_range_mm": (3.0, 4.0),
        "focus_range_dpt": (0, 0),
        "object_range_dpt": (0, 1),
        "gaze_range_deg": (4.0, 0.0),
        "prepare": "ranges",
        "tolerance": "loose",
    }
    states = (ViewState("left", 3.0, None, (3.0, 0.0)), ViewState("right"))
    myope = {"kind": "prescription", "sphere_dpt": -12}
    profiles = {"left": myope, "right": {"kind": "preset", "name": "keratoconus"}}
    see = SEE | {"gaze_deg": (-3.0, 0.0)}
    for state, seen in zip(states, (left, right), strict=True):
        real_client.set_profile(
            profiles[state.eye], eye=state.eye, settings=settings, views=[seen]
        )
    reply = real_client.filter([left, right], **see, states=states)
    for state, seen, color in zip(states, (left, right), reply.colors, strict=True):
        own = {
            "pupil_diameter_mm": state.pupil_diameter_mm or SEE["pupil_diameter_mm"],
            "gaze_deg": state.gaze_deg or see["gaze_deg"],
        }
        body = body_of_eye(profiles[state.eye], state.eye)
        with EyeFilter(body, seen.camera, FilterSettings(**settings)) as alone:
            alone.wait()
            wanted = alone.filter(seen, **(see | own)).color
        np.testing.assert_allclose(color, wanted, atol=2e-6)
    assert edge_width_px(reply.colors[0]) != edge_width_px(reply.colors[1])


def test_a_frame_turns_the_gaze_and_is_told_when_it_turns_too_far(real_client):
    view = edge_view()
    settings = ONE_STATE | {"gaze_range_deg": (15.0, 0.0)}
    eye = {"kind": "preset", "name": "keratoconus"}
    real_client.set_profile(eye, settings=settings, views=[view])
    straight, aside, beyond = (
        real_client.filter(view, **SEE, gaze_deg=gaze_deg)
        for gaze_deg in (None, (15.0, 0.0), (30.0, 0.0))
    )
    assert straight.gaze_deg == (0.0, 0.0)
    assert aside.gaze_deg == beyond.gaze_deg == (15.0, 0.0)
    assert np.abs(straight.color - aside.color).max() > 0.01
    np.testing.assert_array_equal(aside.color, beyond.color)
    assert any("gaze (30, 0) deg" in note for note in beyond.notes)
    assert not any("gaze" in note for note in aside.notes)
    assert aside.overflow_count == 0
    with pytest.raises(errors.BuildFailed, match="gaze_range_deg"):
        real_client.set_profile(
            eye, settings=settings | {"gaze_range_deg": (55.0, 0.0)}, views=[view]
        )


def test_a_gaze_far_to_the_side_is_prepared(real_client):
    """The axis, on which the eye focuses, is not in the picture then."""
    view = edge_view()
    settings = {**ONE_STATE, "gaze_deg": (50.0, 0.0)}
    ready = real_client.set_profile("myopia", settings=settings, views=[view])
    assert ready.is_complete
    seen = real_client.filter(view, **SEE)
    assert np.isfinite(seen.color).all()


@pytest.mark.parametrize(
    ("size", "settings", "field"),
    [
        ((160, 90), {"gaze_range_deg": (60.0, 0.0)}, "settings.gaze_range_deg"),
        ((1, 1), {}, "camera"),
    ],
)
def test_what_cannot_be_built_as_asked_is_named(real_client, size, settings, field):
    with pytest.raises(errors.BuildFailed) as caught:
        real_client.set_profile(
            PLAIN, settings={**NARROW, **settings}, views=[edge_view(*size)]
        )
    assert caught.value.field == field
    assert caught.value.allowed


def test_bright_half_floats_scale_through_the_service(real_client):
    view = edge_view()
    bright = RgbdView(
        (100 * view.color - 10).astype(np.float16), view.depth_m, view.tangents
    )
    real_client.set_profile(MYOPIA, settings=ON_AXIS, views=[view])
    plain = real_client.filter(view, **SEE)
    seen = real_client.filter(bright, **SEE | {"output": "linear16"})
    assert seen.color.dtype == np.float16
    expected = 100 * plain.color - 10
    assert np.abs(seen.color.astype(np.float32) - expected).max() <= 0.05
    assert seen.views[0].color.dtype == "float16"


@pytest.mark.long("frames are filtered until an eye is built")
def test_frames_go_on_while_an_eye_is_built_and_each_names_its_own(real_client):
    view = edge_view()
    old = real_client.set_profile(PLAIN, settings=ON_AXIS, views=[view])
    new = real_client.set_profile(
        MYOPIA, settings={"pupil_range_mm": (3, 5)}, wait=False
    )
    widths_px = {old.generation: set(), new.generation: set()}
    while len(widths_px[new.generation]) == 0:
        if real_client.n_unanswered == 0:
            real_client.submit(view, **SEE)
        for event in real_client.poll(10.0):
            assert not isinstance(event, Dropped)
            if isinstance(event, FilteredFrame):
                width_px = edge_width_px(event.color)
                widths_px[event.generation].add(width_px)
    assert max(widths_px[old.generation]) <= 1
    assert min(widths_px[new.generation]) >= 4


def test_a_wrong_profile_is_named_by_field(real_client):
    with pytest.raises(errors.UnknownProfile) as caught:
        real_client.set_profile(MYOPIA | {"sphere_dpt": -600})
    assert caught.value.field == "sphere_dpt"
    assert "-30 to 30" in caught.value.allowed
    assert "-600" in caught.value.message
    assert "allowed" not in caught.value.message


def test_a_blur_beyond_the_cap_is_an_error_and_not_a_wrong_image(real_client):
    telescope = Camera(2000, 10, (-0.05, 0.05, 0.00025, -0.00025))
    with pytest.raises(errors.GridTooLarge, match="255"):
        real_client.set_profile(MYOPIA, settings=NARROW, views=[telescope])


def test_a_plan_beyond_the_memory_budget_is_refused_with_the_numbers(real_client):
    telescope = Camera(2000, 10, (-0.05, 0.05, 0.00025, -0.00025))
    with pytest.raises(errors.GridTooLarge, match=r"MB for \d+ PSFs") as caught:
        real_client.set_profile(
            MYOPIA,
            settings={"mode": "on-axis", "prepare": "ranges"},
            views=[telescope],
        )
    assert caught.value.allowed == "2000 MB"


@pytest.mark.long("processes start and three eyes are computed")
def test_a_killed_worker_is_told_and_the_next_build_works(real_service, real_client):
    view = edge_view()
    real_client.set_profile(PLAIN, settings=ON_AXIS, views=[view])
    render = real_service.pids()["render"]
    children = Path(f"/proc/{render}/task").glob("*/children")
    pids = {int(pid) for file in children for pid in file.read_text().split()}
    workers = [
        pid
        for pid in pids
        if b"from_profile:build" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    assert len(workers) == 1

    def kill(progress):
        os.kill(workers[0], signal.SIGKILL)

    with pytest.raises(errors.WorkerCrashed, match="SIGKILL"):
        real_client.set_profile(
            {"kind": "preset", "name": "keratoconus"}, views=[view], on_progress=kill
        )
    assert edge_width_px(real_client.filter(view, **SEE).color) <= 1
    real_client.set_profile(MYOPIA, settings=ON_AXIS, views=[view])
    assert edge_width_px(real_client.filter(view, **SEE).color) >= 4


def test_a_remote_interface_is_refused_by_the_program():
    finished = run_command("serve", "--bind", "tcp://0.0.0.0:1")
    assert finished.returncode == 2
    assert "ocufilter keys add" in finished.stderr


@pytest.mark.long("an eye is estimated, traced and computed")
def test_an_eye_is_estimated_and_traced_with_progress_and_answers_larger_pupils(
    real_client,
):
    view, stages = edge_view(), []
    ready = real_client.set_profile(
        {"kind": "preset", "name": "cataract"},  # measured at 4 mm
        settings={"pupil_range_mm": (4.0, 5.0), "object_range_dpt": (0, 1)},
        views=[view],
        on_progress=lambda progress: stages.append(progress.stage),
    )
    assert {"eye", "aberrations", "psfs"} <= set(stages)
    assert any("mean error" in note for note in ready.notes)
    reply = real_client.filter(view, **SEE | {"pupil_diameter_mm": 5.0})
    assert reply.pupil_diameter_mm == pytest.approx(5.0)
    assert not any("capped" in note for note in reply.notes)


def test_each_part_of_an_eye_names_its_error(real_client):
    settings = NARROW | {"focus_range_dpt": (0, 1), "mode": "on-axis"}
    emmetropia = {"kind": "preset", "name": "emmetropia"}
    ready = real_client.set_profile(emmetropia, settings=settings, views=[edge_view()])
    for part in ("eye", "focus", "aberrations"):
        (said, *_) = [note for note in ready.notes if note.startswith(part)]
        assert re.search(r"\d (um|mm|dpt)\b", said)


def test_lateral_color_is_asked_of_a_traced_eye(real_client):
    view = edge_view()
    settings = ONE_STATE
    images = {}
    for eye_model, lateral in (
        ("traced", True),
        ("traced", False),
        ("wavefront", True),
    ):
        ready = real_client.set_profile(
            {"kind": "preset", "name": "emmetropia"},
            settings=settings | {"eye_model": eye_model, "lateral_color": lateral},
            views=[view],
        )
        holds_none = any("lateral_color has no effect" in note for note in ready.notes)
        assert holds_none == (eye_model == "wavefront")
        images[eye_model, lateral] = real_client.filter(view, **SEE).color
    assert np.abs(images["traced", True] - images["traced", False]).max() > 0.005


@pytest.mark.parametrize("eye_model", ["traced", "wavefront"])
def test_cones_weigh_the_pupil_where_that_is_asked_for(real_client, eye_model):
    view = edge_view()
    settings = {
        **ONE_STATE,
        "mode": "on-axis",
        "prepare": "ranges",
        "eye_model": eye_model,
    }
    images = {}
    for eye_side, stiles_crawford in (
        ("OD", False),
        ("OS", False),
        ("OD", True),
        ("OS", True),
    ):
        real_client.set_profile(
            {
                "kind": "prescription",
                "eye_side": eye_side,
                "sphere_dpt": -2,
                "higher_order": "none",  # which are of one side
                "periphery": "model",  # so is that of people
            },
            settings=settings | {"stiles_crawford": stiles_crawford},
            views=[view],
        )
        images[eye_side, stiles_crawford] = real_client.filter(view, **SEE).color
    np.testing.assert_array_equal(images["OD", False], images["OS", False])
    assert np.abs(images["OD", True] - images["OD", False]).max() > 0.005
    assert np.abs(images["OD", True] - images["OS", True]).max() > 0.005


def test_the_light_option_is_the_measured_wavefront_up_to_its_pupil(real_client):
    view = edge_view()
    real_client.set_profile(
        {"kind": "preset", "name": "cataract"},
        settings={
            "pupil_range_mm": (3.0, 5.0),
            "object_range_dpt": (0, 1),
            "eye_model": "wavefront",
        },
        views=[view],
    )
    reply = real_client.filter(view, **SEE | {"pupil_diameter_mm": 5.0})
    assert reply.pupil_diameter_mm == pytest.approx(4.0)
    assert any("capped" in note for note in reply.notes)
