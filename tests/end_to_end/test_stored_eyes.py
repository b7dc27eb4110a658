"""The real PSFs while a stream goes on; the eye from disk next time."""

import time

import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import ServiceProcess
from filter_service.camera import tangents_from_fov
from filter_service.messages import Dropped, Ready

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0, "output": "linear"}
SETTINGS = {
    "mode": "dynamic",
    "tolerance": "loose",
    "pupil_range_mm": (3.5, 4.5),
    "focus_range_dpt": (0.0, 1.0),
    "object_range_dpt": (0.0, 1.0),
}
EYE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2, "age_years": 20}
FROM_DISK = "eye from the disk cache"


@pytest.fixture(scope="module")
def view():
    """A checkerboard 2 m away."""
    y, x = np.mgrid[:72, :128]
    color = np.repeat((x // 8 + y // 8) % 2, 3).reshape(72, 128, 3)
    depth_m = np.full((72, 128), 2.0, np.float32)
    return RgbdView(color.astype(np.float32), depth_m, tangents_from_fov(40.0, 128, 72))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("stores")


@pytest.fixture(scope="module")
def built(folder, view):
    """Stream through a service that has nothing on disk; return what it said."""
    with (
        ServiceProcess(
            {"store_cache_dir": str(folder)}, start_timeout_s=30.0
        ) as service,
        FilterClient(service.endpoint, timeout_s=10.0) as client,
    ):
        client.set_profile(EYE | {"sphere_dpt": 0}, views=[view])
        client.filter(view, **SEE)
        client.set_profile(EYE, settings=SETTINGS, wait=False)
        events = []
        end_s = time.monotonic() + 30.0
        while not any(isinstance(e, Ready) and e.is_complete for e in events):
            assert time.monotonic() < end_s, "not ready in time"
            if client.n_unanswered == 0:
                client.submit(view, **SEE)
            events += client.poll(1.0)
        while client.n_unanswered:
            events += client.poll(1.0)
        last = client.filter(view, **SEE)
        while len(list(folder.glob("*.psfs"))) < 2:
            assert time.monotonic() < end_s, "the stores were not written in time"
            time.sleep(0.05)
    return events, last


def test_every_frame_shows_one_of_the_two_eyes(built):
    events, last = built
    (ready,) = [e for e in events if isinstance(e, Ready)]
    assert ready.is_complete
    assert ready.psf_count > 0
    assert not [e for e in events if isinstance(e, Dropped)]
    frames = [e for e in events if isinstance(e, FilteredFrame)]
    assert all(frame.is_complete for frame in frames)
    new = [f for f in frames if f.generation == ready.generation]
    old = [f for f in frames if f.generation != ready.generation]
    assert len(old) > 2, "the stream stopped"
    for frame in new:
        np.testing.assert_array_equal(frame.color, last.color)
    for frame in old:
        np.testing.assert_array_equal(frame.color, old[0].color)
    assert not np.array_equal(old[0].color, last.color)


@pytest.mark.long("a service starts and computes an eye")
def test_a_restarted_service_takes_the_eye_from_disk(built, folder, view):
    _, last = built
    with (
        ServiceProcess(
            {"store_cache_dir": str(folder)}, start_timeout_s=30.0
        ) as service,
        FilterClient(service.endpoint, timeout_s=10.0) as client,
    ):
        ready = client.set_profile(EYE, settings=SETTINGS, views=[view], wait="first")
        assert ready.is_complete
        assert FROM_DISK in ready.notes
        assert any("mean error" in note for note in ready.notes)
        np.testing.assert_array_equal(client.filter(view, **SEE).color, last.color)
        other = client.set_profile(
            EYE, settings=SETTINGS | {"diffraction": False}, views=[view]
        )
        assert FROM_DISK not in other.notes


@pytest.mark.slow
def test_a_damaged_file_costs_a_build_and_a_word(built, folder, view):
    _, last = built
    for path in folder.glob("*.psfs"):
        data = bytearray(path.read_bytes())
        data[-100] ^= 1
        path.write_bytes(data)
    with (
        ServiceProcess(
            {"store_cache_dir": str(folder)}, start_timeout_s=30.0
        ) as service,
        FilterClient(service.endpoint, timeout_s=10.0) as client,
    ):
        ready = client.set_profile(EYE, settings=SETTINGS, views=[view])
        assert FROM_DISK not in ready.notes
        again = client.filter(view, **SEE).color
        np.testing.assert_array_equal(again, last.color)
        assert "removed" in service.log
