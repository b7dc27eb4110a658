"""The thread behind the page: small picture, then full; the newest wish wins."""

import dataclasses
import io
import json
import queue
import struct

import numpy as np
import pytest
from PIL import Image

from clients.web.filter_thread import FilterThread, PictureRequest
from clients.web.picture import linear_from_srgb8
from filter_service import EyeFilter, FilterSettings
from filter_service.messages import State
from tests.unit.web_parts import a_picture

WAIT_S = 60.0


class Screen:
    """What a page was shown, in order."""

    def __init__(self):
        self.seen = queue.Queue()

    def until(self, kind, number, eye="OD"):
        """Return what was shown up to there."""
        shown = []
        while True:
            shown.append(self.seen.get(timeout=WAIT_S))
            last = shown[-1]
            if (last.kind, last.number, last.eye) == (kind, number, eye):
                return shown


@pytest.fixture(scope="module")
def filter_thread():
    filter_thread = FilterThread()
    yield filter_thread
    filter_thread.close()


@pytest.fixture
def screen(filter_thread):
    screen = Screen()
    filter_thread.open("page", screen.seen.put)
    yield screen
    filter_thread.forget("page")


def request(number, sphere_dpt=-3.0, eyes=("OD",), pupil_mm=4.0, picture=None):
    bodies = {
        eye: {"kind": "prescription", "sphere_dpt": sphere_dpt, "eye_side": eye}
        for eye in eyes
    }
    picture = picture or a_picture()
    return PictureRequest(number, picture, bodies, State(pupil_mm, 0.0, (0.0, 0.0)))


def pixels(seen):
    return np.asarray(Image.open(io.BytesIO(seen.data)).convert("RGB"))


def psnr_db(first, second):
    """Of linear light."""
    first, second = map(linear_from_srgb8, (first, second))
    return -10.0 * np.log10(max(np.mean((first - second) ** 2), 1e-12))


@pytest.mark.long("eyes are built, for a preview and in full")
def test_small_then_full_and_the_full_one_is_the_filters_own(filter_thread, screen):
    filter_thread.request("page", request(1))
    preview, full = screen.until("full", 1)
    assert preview.kind == "preview"
    view = request(1).picture.view
    settings = FilterSettings(focus_range_dpt=(0.0, 8.0))
    with EyeFilter(request(1).bodies["OD"], view.camera, settings) as other:
        state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
        other.filter([view], **state)
        other.wait()
        expected = other.filter([view], **state).color
    # both interpolate between nodes that differ: within what the plan promises
    assert psnr_db(pixels(full), expected) > 36.0
    assert psnr_db(view.color, expected) < 15.0


@pytest.mark.long("eyes are built, for a preview and in full")
def test_of_wishes_that_wait_the_newest_is_seen(filter_thread, screen):
    for number in range(1, 41):
        filter_thread.request("page", request(number, sphere_dpt=-number / 8.0))
    shown = screen.until("full", 40)
    assert [seen.number for seen in shown if seen.kind == "full"] == [40]
    assert len(shown) < 40  # most were never begun


@pytest.mark.long("eyes are built, for a preview and in full")
def test_both_eyes_are_seen_each_through_its_own(filter_thread, screen):
    both = request(1, eyes=("OD", "OS"))
    both.bodies["OS"]["sphere_dpt"] = 0.0
    filter_thread.request("page", both)
    shown = screen.until("full", 1, "OS")
    full = {seen.eye: pixels(seen) for seen in shown if seen.kind == "full"}
    assert full["OD"].std() < 0.8 * full["OS"].std()


@pytest.mark.clients
def test_the_published_pipeline_is_that_of_the_filter(filter_thread, screen):
    filter_thread.request("page", dataclasses.replace(request(1), pipeline="published"))
    full = screen.until("full", 1)[-1]
    view = request(1).picture.view
    with EyeFilter(
        request(1).bodies["OD"], view.camera, {"pipeline": "published"}
    ) as other:
        seen = other.filter([view], pupil_diameter_mm=4.0, focus_dpt=0.0, whole=True)
    assert psnr_db(pixels(full), seen.color) > 50.0


def test_a_header_and_a_file_travel_together(filter_thread, screen):
    filter_thread.request("page", request(1))
    data = screen.until("preview", 1)[-1].packed()
    (length,) = struct.unpack_from("<I", data)
    header = json.loads(data[4 : 4 + length])
    assert (header["kind"], header["eye"], header["number"]) == ("preview", "OD", 1)
    assert Image.open(io.BytesIO(data[4 + length :])).size == (60, 40)


@pytest.mark.long("eyes are built, for a preview and in full")
def test_what_cannot_be_seen_is_told_and_the_next_is_seen(filter_thread, screen):
    filter_thread.request("page", request(1, pupil_mm=40.0))
    (failed, *_) = screen.until("failed", 1)
    assert "pupil_diameter_mm: it is 40.0" in failed.facts["error"]
    filter_thread.request("page", request(2))
    screen.until("full", 2)


@pytest.mark.long("eyes are built, for a preview and in full")
def test_a_fault_of_one_page_does_not_end_the_others(filter_thread, screen):
    other = Screen()
    filter_thread.open("other", other.seen.put)
    broken = dataclasses.replace(request(1), state=State(4.0, 0.0, ("far", 0.0)))
    filter_thread.request("other", broken)
    failed = other.until("failed", 1)[-1]
    assert failed.facts["error"]
    filter_thread.request("page", request(1))
    screen.until("full", 1)
    filter_thread.request("other", request(2))
    other.until("full", 2)
    filter_thread.forget("other")
