"""The real PSFs in steps: a preview first, the whole after it, from disk next time."""

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
    "prepare": "ranges",  # whatever frames came before
    "tolerance": "loose",
    "pupil_range_mm": (2.5, 6.0),
    "focus_range_dpt": (0.0, 2.0),
    "object_range_dpt": (0.0, 2.0),
}
EYE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2, "age_years": 20}
FROM_DISK = "PSFs from the disk cache"


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


def test_the_new_eye_is_seen_by_a_preview_and_then_whole(built):
    events, last = built
    ready = [e for e in events if isinstance(e, Ready)]
    assert [e.is_complete for e in ready] == [False, True]
    assert ready[0].psf_count < ready[1].psf_count
    assert ready[0].build_ms < ready[1].build_ms
    assert not [e for e in events if isinstance(e, Dropped)]
    frames = [e for e in events if isinstance(e, FilteredFrame)]
    previews = [f for f in frames if not f.header.is_complete]
    assert previews, "no frame went through the preview"
    assert {f.header.generation for f in previews} == {ready[0].generation}
    # The preview is for this very pupil and focus, so it is like the whole.
    assert last.header.is_complete
    of_preview, of_old_eye = (
        float(np.sqrt(np.mean(np.square(frame.color - last.color))))
        for frame in (previews[0], frames[0])
    )
    # A plan for 43 dB of a picture; a checkerboard has 8 dB more contrast.
    assert of_preview < 10.0 ** (-34.0 / 20.0)
    assert of_old_eye > 1.3 * of_preview


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
        again = client.filter(view, **SEE).color  # built anew: equal to rounding
        np.testing.assert_allclose(again, last.color, atol=1e-5)
        assert "is removed" in service.log
