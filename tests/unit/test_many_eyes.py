"""A new eye for each image: without a worker process, and in ranges of one state."""

import multiprocessing
import pickle
import sys

import numpy as np
import pytest

from filter_service import EyeFilter, FilterSettings, blas_threads
from filter_service.camera import Camera
from filter_service.errors import FilterError
from filter_service.filtering.shared_builder import shared

CAMERA = Camera.from_fov(8.0, width_px=64, height_px=48)
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
SETTINGS = FilterSettings(
    mode="on-axis",
    pupil_range_mm=(4.0, 4.0),
    focus_range_dpt=(0.5, 0.5),
    object_planes_dpt=(0.5,),
)


def person(number):
    """Return a person who is drawn from the population."""
    return {
        "kind": "prescription",
        "sphere_dpt": -0.5 * number,
        "cylinder_dpt": -0.5,
        "axis_deg": 20.0 * number + 10.0,
        "age_years": 30.0,
        "sample": number,
    }


@pytest.fixture(scope="module")
def frame():
    color = np.random.default_rng(3).integers(0, 256, (48, 64, 3), np.uint8)
    return color, np.full((48, 64), 2.0, np.float32)


def seen(eye_filter, frame, number):
    eye_filter.set_profile(person(number))
    return eye_filter.filter(*frame, **STATE, whole=True).color


@pytest.mark.long("starts a worker process")
def test_images_do_not_depend_on_the_worker(frame):
    found = []
    for worker in (True, False):
        with EyeFilter(
            camera=CAMERA, settings=SETTINGS, engine="native", worker=worker
        ) as eye_filter:
            assert eye_filter.builder.worker.has_process == worker
            found.append([seen(eye_filter, frame, number) for number in (1, 2)])
    found.append([])
    processes = set()
    for number in (1, 2):  # one filter after the other
        with EyeFilter(camera=CAMERA, settings=SETTINGS, engine="native") as eye_filter:
            processes.add(eye_filter.builder.worker._worker.process.pid)
            found[-1].append(seen(eye_filter, frame, number))
    assert len(processes) == 1
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    assert np.any(found[0][0] != found[0][1])  # two persons


def send_image(sender, frame):
    """Send an image, and whether a process estimated its eye (a child)."""
    with EyeFilter(camera=CAMERA, settings=SETTINGS, engine="native") as eye_filter:
        image = seen(eye_filter, frame, 1)
        sender.send((image, eye_filter.builder.worker.has_process))


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.long("builds an eye twice")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_daemonic_processes_start_none(frame, method):
    context = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=send_image, args=(sender, frame), daemon=True)
    with EyeFilter(
        camera=CAMERA, settings=SETTINGS, engine="native", worker=False
    ) as eye_filter:
        expected = seen(eye_filter, frame, 1)
        child.start()
        image, has_process = receiver.recv()
        child.join()
    assert not has_process
    np.testing.assert_array_equal(image, expected)


def test_a_filter_refuses_to_be_pickled():
    with (
        EyeFilter(engine="native", worker=False) as eye_filter,
        pytest.raises(TypeError, match="open one in each process"),
    ):
        pickle.dumps(eye_filter)


def test_builders_with_and_without_a_worker_are_shared_apart():
    assert shared("native", has_worker=True) is not shared("native", has_worker=False)


def test_a_failed_eye_without_a_worker_raises(frame):
    thick = {"kind": "prescription", "sphere_dpt": -30.0}
    with EyeFilter(
        camera=CAMERA, settings=SETTINGS, engine="native", worker=False
    ) as eye_filter:
        with pytest.raises((FilterError, ValueError)):
            eye_filter.set_profile(thick | {"sphere_dpt": -300.0})
        assert seen(eye_filter, frame, 1).shape == (48, 64, 3)


def test_blas_is_limited_for_a_while():
    functions = blas_threads._openblas()
    if functions is None:
        pytest.skip("this NumPy does not use OpenBLAS")
    get_count, set_count = functions
    before = get_count()
    try:
        set_count(2)
        with blas_threads.one_blas_thread():
            assert get_count() == 1
        assert get_count() == 2
        with pytest.raises(KeyError), blas_threads.one_blas_thread():
            raise KeyError
        assert get_count() == 2
    finally:
        set_count(before)
