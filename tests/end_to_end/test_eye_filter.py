"""`EyeFilter`: the service's own object in this process, with doubles and for real."""

import multiprocessing
import os
import resource
import time
from contextlib import ExitStack

import numpy as np
import pytest

from filter_service import (
    BuildingEye,
    Camera,
    EyeFailed,
    EyeFilter,
    EyeReady,
    FilterSettings,
    Preparing,
    RgbdView,
)
from filter_service.building.jobs import BuildLimits
from filter_service.building.worker_handle import InlineWorker, WorkerHandle
from filter_service.errors import (
    BadMessage,
    BuildCancelled,
    BuildFailed,
    NoProfile,
    RenderFailed,
    ServiceTimeout,
)
from filter_service.filtering.builder import Builder
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.native import NativeRenderer
from tests.end_to_end.doubles import EngineDouble, ProfileDouble
from tests.end_to_end.printed_script import printed_by

CAMERA = Camera.from_fov(60.0, width_px=16, height_px=8)
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
COLOR = np.full((8, 16, 3), 10, np.uint8)
DEPTH_M = np.full((8, 16), 2.0, np.float32)


@pytest.fixture(scope="module")
def builder():
    worker = WorkerHandle("tests.end_to_end.doubles:build")
    builder = Builder(worker, EngineDouble(0.0), BuildLimits())
    yield builder
    builder.close()


@pytest.fixture
def events():
    return []


@pytest.fixture
def eye_filter(builder, events):
    with EyeFilter(None, CAMERA, builder=builder, on_event=events.append) as made:
        yield made


def eye(mark, **more):
    return ProfileDouble({"kind": "double", "mark": mark, **more})


def mark_of(seen):
    return int(seen.color[0, 0, 0])


def test_a_picture_comes_through_the_eye_of_the_profile(eye_filter, events):
    eye_filter.set_profile(eye(7))
    seen = eye_filter.filter(COLOR, DEPTH_M, **SEE)
    assert mark_of(seen) == 7
    assert seen.generation == 1
    assert (seen.color[1:] == 245).all()
    assert [type(event) for event in events][-1] is EyeReady


def test_frames_go_through_the_old_eye_while_the_new_one_is_built(eye_filter, events):
    eye_filter.set_profile(eye(1))
    eye_filter.filter(COLOR, DEPTH_M, **SEE)
    eye_filter.set_profile(eye(3, build_s=0.15))
    marks = []
    deadline_s = time.monotonic() + 10.0
    while marks[-1:] != [3] and time.monotonic() < deadline_s:
        marks.append(mark_of(eye_filter.filter(COLOR, DEPTH_M, **SEE)))
    assert list(dict.fromkeys(marks)) == [1, 3]
    assert len(marks) > 20, "frames waited for the build"
    assert any(isinstance(event, BuildingEye) for event in events)


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_frame_keeps_its_store_until_it_is_finished_or_dropped(
    eye_filter, is_finished
):
    view = RgbdView(COLOR, DEPTH_M, CAMERA.tangents)
    eye_filter.set_profile(eye(7))
    eye_filter.filter(view, **SEE)
    (prepared,) = eye_filter.prepared_stores
    finish = eye_filter.begin([view], **SEE)
    eye_filter.set_profile(eye(8))
    assert mark_of(eye_filter.filter(view, whole=True, **SEE)) == 8
    assert prepared.store.n_released == 0
    if is_finished:
        assert mark_of(finish()) == 7
    else:
        del finish
    eye_filter.filter(view, **SEE)
    assert prepared.store.n_released == 1


def test_a_profile_that_fails_leaves_the_old_eye_in_use(eye_filter, events):
    eye_filter.set_profile(eye(1))
    eye_filter.wait(10.0)
    eye_filter.set_profile(eye(2, fail=True))
    with pytest.raises(BuildFailed, match="told to fail"):
        eye_filter.wait(10.0)
    assert mark_of(eye_filter.filter(COLOR, DEPTH_M, **SEE)) == 1
    assert isinstance(events[-1], EyeFailed)


def test_a_wait_ends_where_nothing_more_will_come(eye_filter, builder):
    eye_filter.set_profile(eye(2, fail=True))
    for _ in range(2):
        with pytest.raises(BuildFailed, match="told to fail"):
            eye_filter.wait(10.0)
    with EyeFilter(eye(1), builder=builder) as blind:
        with pytest.raises(BadMessage, match="camera: it is missing"):
            blind.wait(10.0)


def test_a_program_with_many_open_files_can_wait():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2048:
        pytest.skip("this machine allows no more than a thousand open files")
    with ExitStack() as closing:
        resource.setrlimit(resource.RLIMIT_NOFILE, (2048, hard))
        closing.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1024):
            closing.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        worker = WorkerHandle("tests.end_to_end.doubles:build")
        many = Builder(worker, EngineDouble(0.0), BuildLimits())
        closing.callback(many.close)
        with EyeFilter(eye(1), CAMERA, builder=many) as made:
            assert isinstance(made.wait(10.0), EyeReady)


def test_a_filter_that_could_not_be_made_holds_nothing(builder, monkeypatch):
    def fails(*_, **__):
        raise MemoryError

    monkeypatch.setattr(builder, "accept", fails)
    with pytest.raises(MemoryError):
        EyeFilter(eye(1), CAMERA, builder=builder)
    assert builder.streams == []


def test_a_newer_profile_takes_the_place_of_one_that_is_being_built(eye_filter, events):
    eye_filter.set_profile(eye(1, build_s=30.0))
    eye_filter.set_profile(eye(2))
    eye_filter.wait(10.0)  # the end of the other is not its own
    assert mark_of(eye_filter.filter(COLOR, DEPTH_M, **SEE)) == 2
    (failed,) = [event for event in events if isinstance(event, EyeFailed)]
    assert isinstance(failed.error, BuildCancelled)
    assert failed.eye.generation == 1


@pytest.mark.long("a process builds an eye")
def test_frames_that_never_wait_are_enough_to_prepare_an_eye():
    """Nobody else lets the build go on where a filter has a workshop of its own."""
    camera = Camera.from_fov(20.0, width_px=16, height_px=8)
    settings = FilterSettings(mode="on-axis", eye_model="wavefront")
    view, end_s = RgbdView(COLOR, DEPTH_M, camera.tangents), time.monotonic() + 60.0
    with EyeFilter("myopia", camera, settings, engine="native") as eye_filter:
        while not (seen := eye_filter.try_filter([view], **SEE)):
            assert seen.reason == "preparing"
            assert time.monotonic() < end_s, "the eye was never ready"
            time.sleep(0.01)
    assert seen.color.shape == COLOR.shape


def test_an_eye_is_prepared_while_its_filter_is_not_called(eye_filter, events):
    eye_filter.set_profile(eye(4))
    end_s = time.monotonic() + 20.0
    while not [store for store in eye_filter.prepared_stores if store.is_ready]:
        assert time.monotonic() < end_s, "the eye was never ready"
        time.sleep(0.001)
    assert events == [], "events were delivered in another thread"
    eye_filter.wait(10.0)
    assert isinstance(events[-1], EyeReady)


def test_a_new_eye_keeps_the_settings_unless_told_others(builder):
    own = FilterSettings(mode="on-axis")
    with EyeFilter(None, CAMERA, own, builder=builder) as made:
        assert made.set_profile(eye(1)).settings is own
        other = FilterSettings(mode="quality")
        assert made.set_profile(eye(2), settings=other).settings is other


def test_streams_share_a_workshop_and_keep_their_eyes(builder):
    with (
        EyeFilter(eye(1), CAMERA, builder=builder) as left,
        EyeFilter(eye(2), CAMERA, builder=builder) as right,
    ):
        assert mark_of(left.filter(COLOR, DEPTH_M, **SEE)) == 1
        assert mark_of(right.filter(COLOR, DEPTH_M, **SEE)) == 2
    assert builder.streams == []


def test_two_views_make_two_pictures_and_a_new_camera_is_waited_for(eye_filter):
    eye_filter.set_profile(eye(9))
    wide = RgbdView(COLOR, DEPTH_M, (-0.9, 0.9, 0.4, -0.4))
    near = RgbdView(COLOR, DEPTH_M, CAMERA.tangents)
    seen = eye_filter.filter([wide, near], **SEE)
    assert len(seen.colors) == 2


def test_what_is_missing_or_wrong_is_named(eye_filter, builder):
    with pytest.raises(NoProfile):
        eye_filter.filter(COLOR, DEPTH_M, **SEE)
    with pytest.raises(BadMessage, match="depth: it is missing"):
        eye_filter.filter(COLOR, **SEE)
    for wrong in (COLOR.tolist(), None, ["view"]):
        with pytest.raises(BadMessage, match=r"color: .* an RgbdView, or several"):
            eye_filter.filter(wrong, DEPTH_M, **SEE)
    with pytest.raises(ValueError, match=r"pupil_diameter_mm: it is 30\.0"):
        eye_filter.filter(COLOR, DEPTH_M, pupil_diameter_mm=30.0, focus_dpt=0.0)
    with pytest.raises(ValueError, match="is out of range"):
        eye_filter.set_profile({"kind": "prescription", "sphere_dpt": -100})
    with pytest.raises(BadMessage, match=r"camera: .*64x36"):
        EyeFilter(eye(1), ["64x36"], builder=builder)
    with pytest.raises(BadMessage, match=r"settings: .*'mod'"):
        EyeFilter(eye(1), CAMERA, {"mod": "quality"}, builder=builder)
    with EyeFilter(eye(1), builder=builder) as blind:
        with pytest.raises(BadMessage, match="camera: it is missing"):
            blind.filter(COLOR, DEPTH_M, **SEE)
    with pytest.raises(ValueError, match="is closed"):
        blind.set_profile(eye(1))
    eye_filter.set_profile(eye(1, build_s=5.0, hang=True))
    with pytest.raises(ServiceTimeout, match="the eye to be ready"):
        eye_filter.wait(0.05)


SCRIPT = """
import numpy as np
from filter_service import Camera, EyeFilter, FilterSettings

camera = Camera.from_fov(6.0, width_px=64, height_px=36)
settings = FilterSettings(mode="on-axis", eye_model="wavefront")
rows, columns = np.indices((36, 64))
color = np.repeat((255 * (columns // 8 % 2))[..., None], 3, axis=2).astype(np.uint8)
depth_m = np.full((36, 64), 0.5, np.float32)
with EyeFilter("myopia", camera, settings) as eye_filter:
    eye_filter.wait()
    seen = eye_filter.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=2.0)
np.save("seen.npy", seen.color)
"""


@pytest.mark.long("a process of its own, and an eye in each")
def test_a_plain_script_gets_the_picture_that_another_program_gets(tmp_path):
    """No guard for the main module, and the same bytes as in this process.

    `tests/end_to_end/test_one_path.py` compares these with a service's.
    """
    printed_by("-c", SCRIPT, cwd=tmp_path)
    mine = np.load(tmp_path / "seen.npy")

    camera = Camera.from_fov(6.0, width_px=64, height_px=36)
    settings = FilterSettings(mode="on-axis", eye_model="wavefront")
    columns = np.indices((36, 64))[1]
    color = np.repeat((255 * (columns // 8 % 2))[..., None], 3, axis=2)
    depth_m = np.full((36, 64), 0.5, np.float32)
    with EyeFilter("myopia", camera, settings) as eye_filter:
        theirs = eye_filter.filter(
            color.astype(np.uint8), depth_m, pupil_diameter_mm=4.0, focus_dpt=2.0
        )
    np.testing.assert_array_equal(mine, theirs.color)
    assert len(np.unique(mine[18, :, 1])) > 4, "nothing was blurred"


@pytest.mark.long("two eyes are traced and computed")
def test_psfs_of_the_eye_used_longest_ago_are_evicted(rng):
    """And are computed again when a frame comes for it: the picture is the same."""
    color = rng.integers(0, 256, (36, 64, 3)).astype(np.uint8)
    depth_m = rng.uniform(0.4, 4.0, (36, 64)).astype(np.float32)
    camera = Camera.from_fov(50.0, width_px=64, height_px=36)
    own = Builder(InlineWorker(), NativeRenderer(), BuildLimits())
    with (
        EyeFilter("myopia", camera, builder=own) as first,
        EyeFilter("keratoconus", camera, builder=own) as second,
    ):
        before = first.filter(color, depth_m, **SEE).color
        (stored,) = [prepared.store.store for prepared in first.prepared_stores]
        second.filter(color, depth_m, **SEE)
        assert stored.generation == 0
        own._limits = BuildLimits(max_stores_mb=0.5 * own.stores_mb)
        own.await_event(second._eyes)
        assert stored.generation == 1
        assert stored.memory_mb < 0.5 * own.stores_mb
        np.testing.assert_array_equal(first.filter(color, depth_m, **SEE).color, before)
    own.close()


@pytest.mark.long("two eyes are traced")
def test_psfs_that_cannot_be_computed_fail_their_eye_alone(monkeypatch, rng):
    """While they are computed ahead, too: the other streams of the process go on."""
    camera = Camera.from_fov(50.0, width_px=64, height_px=36)
    color = rng.integers(0, 256, (36, 64, 3)).astype(np.uint8)
    depth_m = np.full((36, 64), 2.0, np.float32)
    own, events = Builder(InlineWorker(), NativeRenderer(), BuildLimits()), []
    with EyeFilter("myopia", camera, builder=own, on_event=events.append) as eye_filter:
        before = eye_filter.filter(color, depth_m, **SEE).color

        def fail(*_, **__):
            raise FloatingPointError("not foreseen")

        eye_filter.set_profile("keratoconus")
        with monkeypatch.context() as broken:
            broken.setattr(FrameStore, "computed", fail)
            with pytest.raises(RenderFailed, match="FloatingPointError: not foreseen"):
                eye_filter.wait(20.0)
        assert isinstance(events[-1], EyeFailed)
        after = eye_filter.filter(color, depth_m, **SEE)
    assert after.generation == 1
    np.testing.assert_array_equal(after.color, before)
    own.close()


@pytest.mark.long("an eye is traced and computed twice")
def test_every_frame_of_a_focus_that_jumps_shows_the_asked_state(rng):
    """Frame after frame elsewhere; each is what a filter sees that was asked first."""
    color = rng.integers(0, 256, (54, 96, 3)).astype(np.uint8)
    depth_m = np.full((54, 96), 2.0, np.float32)
    depth_m[:, :32], depth_m[:, 64:] = 0.3, np.inf
    camera = Camera.from_fov(50.0, width_px=96, height_px=54)

    def pictures(states):
        settings = {"tolerance": "loose"}
        with EyeFilter("emmetropia", camera, settings, engine="native") as eye_filter:
            return [
                eye_filter.filter(
                    color, depth_m, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt
                ).color.tobytes()
                for pupil_mm, focus_dpt in states
            ]

    states = [(5.0, 0.0), (3.0, 4.0), (6.5, 2.0)]
    jumping = pictures(states)
    assert jumping == pictures(states[::-1])[::-1]
    assert len(set(jumping)) == 3


@pytest.mark.long("an eye is traced and computed twice")
def test_a_frame_stops_computing_psfs_when_its_time_is_over(rng):
    color = rng.integers(0, 256, (90, 160, 3)).astype(np.uint8)
    depth_m = rng.uniform(0.4, 4.0, (90, 160)).astype(np.float32)
    camera = Camera.from_fov(50.0, width_px=160, height_px=90)
    view = RgbdView(color, depth_m, camera.tangents)
    with EyeFilter("cataract", camera, engine="native") as eye_filter:
        eye_filter.wait()
        state = {"pupil_diameter_mm": 6.0, "focus_dpt": 1.0}
        seen = eye_filter.try_filter([view], **state, until_s=time.monotonic())
        assert isinstance(seen, Preparing)
        assert seen.reason == "extending"
        n_tries, end_s = 0, time.monotonic() + 60.0
        while not seen and time.monotonic() < end_s:
            n_tries += 1
            seen = eye_filter.try_filter([view], **state, until_s=time.monotonic())
        assert seen
        whole = eye_filter.filter(view, **state)
    np.testing.assert_array_equal(seen.color, whole.color)


NARROW = Camera.from_fov(20.0, width_px=16, height_px=8)


def seen_in_child(settings):
    """Return what a child sees whose parent has filtered, and what the parent saw."""
    with EyeFilter("myopia", NARROW, settings) as own:
        picture = own.filter(COLOR, DEPTH_M, **SEE, whole=True).color
        receiver, sender = multiprocessing.Pipe(duplex=False)
        context = multiprocessing.get_context("fork")
        child = context.Process(target=see, args=(sender, settings, own))
        child.start()
        assert receiver.poll(60.0), "the child stands still"
        found = receiver.recv()
        child.join(20.0)
        assert child.exitcode == 0
        again = own.filter(COLOR, DEPTH_M, **SEE).color  # the parent's goes on
        np.testing.assert_array_equal(again, picture)
    return found, picture


def see(sender, settings, of_parent):
    try:
        of_parent.filter(COLOR, DEPTH_M, **SEE)
        refusal = ""
    except ValueError as error:
        refusal = str(error)
    with EyeFilter("myopia", NARROW, settings) as own:
        sender.send((own.filter(COLOR, DEPTH_M, **SEE, whole=True).color, refusal))


@pytest.mark.long("a forked process builds an eye")
@pytest.mark.parametrize(
    "settings",
    [pytest.param(FilterSettings(), marks=pytest.mark.slow), {"mode": "on-axis"}],
)
def test_a_forked_process_has_a_worker_and_threads_of_its_own(settings):
    (picture, refusal), expected = seen_in_child(settings)
    np.testing.assert_array_equal(picture, expected)
    assert "create one in this process" in refusal
