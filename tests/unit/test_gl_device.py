"""On which EGL device OpenGL works: the first that can, or the one that is named."""

import logging
import os
from contextlib import ExitStack

import pytest

from clients.commands.doctor import gl_devices
from filter_service.errors import RenderFailed
from filter_service.filtering.shared_builder import open_engine
from filter_service.gl import choose_device
from filter_service.gl.choose_device import (
    NAME_EXTENSION,
    SOFTWARE_EXTENSION,
    EglDevice,
    _described,
    by_preference,
    egl_devices,
    open_on_device,
)
from filter_service.gl.gpu import Gpu
from filter_service.gl_device import (
    BACKEND_VARIABLE,
    GL_DEVICE_VARIABLE,
    checked_gl_device,
    is_device_selected,
    wanted_gl_device,
)
from filter_service.service.config import load_config

SOFTWARE = EglDevice(0, "software", (SOFTWARE_EXTENSION,))
BROKEN, GOOD = EglDevice(1, "broken"), EglDevice(2, "good")


@pytest.fixture
def three_devices(monkeypatch):
    """Have EGL list a software device, one that fails, and one that works."""
    monkeypatch.setattr(choose_device, "egl_devices", lambda: [SOFTWARE, BROKEN, GOOD])


def opened(index):
    if index == BROKEN.index:
        raise ValueError("no driver\nfor it")
    return f"context {index}"


def test_hardware_is_tried_first_and_what_fails_is_in_the_log(three_devices, caplog):
    with caplog.at_level(logging.WARNING):
        found = open_on_device("auto", opened)
    assert found == ("context 2", 2)
    assert "EGL device 1 (broken): no driver for it" in caplog.text
    assert "using EGL device 2 (good)" in caplog.text


def test_the_first_that_works_says_nothing(three_devices, caplog):
    assert open_on_device("auto", lambda index: index) == (BROKEN.index, BROKEN.index)
    assert not caplog.text


def test_where_none_works_each_says_why(three_devices):
    def fail(index):
        raise ValueError(f"fault {index}")

    with pytest.raises(RenderFailed, match="doctor") as caught:
        open_on_device("auto", fail)
    for device in (SOFTWARE, BROKEN, GOOD):
        assert f"device {device}: fault {device.index}" in str(caught.value)


def test_a_named_device_is_taken_or_refused_and_no_other_tried(three_devices):
    assert open_on_device("0", opened) == ("context 0", 0)
    there_are = r"0 \(software\), 1 \(broken\), 2 \(good\)"
    with pytest.raises(RenderFailed, match=f"gl_device 1 has no .*{there_are}"):
        open_on_device("1", opened)
    with pytest.raises(RenderFailed, match=f"gl_device is 3; allowed: .*{there_are}"):
        open_on_device("3", opened)


def test_a_real_device_that_fails_is_passed_over(monkeypatch, caplog):
    (real, *_) = by_preference(egl_devices())
    first = EglDevice(99, "pulled out")
    monkeypatch.setattr(choose_device, "egl_devices", lambda: [first, real])
    monkeypatch.setattr(choose_device, "by_preference", lambda devices: devices)
    with caplog.at_level(logging.WARNING):
        found = Gpu("auto")
    assert found.info["device"] == real.index
    found.close()
    # The package that opens contexts refused it, by its own count.
    assert "device 99 (pulled out): requested device index 99" in caplog.text


@pytest.mark.gl
def test_a_context_opens_on_each_device_that_doctor_lists():
    listed = gl_devices()
    assert [device["index"] for device in listed] == list(range(len(listed)))
    assert len(listed) == len(egl_devices()) >= 1
    working = [device for device in listed if device["error"] is None]
    assert working
    for device in working:
        found = Gpu(str(device["index"]))
        assert found.info["renderer"] == device["renderer"]
        found.close()
    assert all(device["extensions"] for device in working)


def test_an_index_beyond_the_list_is_refused_with_the_list():
    count = len(egl_devices())
    with pytest.raises(RenderFailed, match=rf"gl_device is {count}; allowed: .*0 \("):
        Gpu(str(count))


@pytest.mark.parametrize("wanted", ["", "first", "-1", "1.5", "²"])
def test_what_is_no_device_is_refused(wanted):
    with pytest.raises(ValueError, match="allowed: auto, or the index"):
        checked_gl_device(wanted)
    with pytest.raises(ValueError, match=f"gl_device is {wanted!r}"):
        load_config(gl_device=wanted)


def test_a_file_may_name_it_as_a_number(tmp_path):
    path = tmp_path / "service.toml"
    path.write_text("gl_device = 2\n")
    assert load_config(path).gl_device == "2"
    assert load_config(path, gl_device="auto").gl_device == "auto"


def test_the_environment_names_it(monkeypatch):
    monkeypatch.delenv(GL_DEVICE_VARIABLE, raising=False)
    monkeypatch.delenv(BACKEND_VARIABLE, raising=False)
    assert wanted_gl_device() == "auto"
    assert not is_device_selected()
    monkeypatch.setenv(BACKEND_VARIABLE, "1")
    assert wanted_gl_device() == "1"
    assert not is_device_selected()
    monkeypatch.setenv(GL_DEVICE_VARIABLE, "0")
    assert wanted_gl_device() == "0"
    assert is_device_selected()
    monkeypatch.setenv(GL_DEVICE_VARIABLE, "x")
    with pytest.raises(ValueError, match=f"{GL_DEVICE_VARIABLE} is 'x'"):
        wanted_gl_device()


def test_the_named_device_wins_over_the_backend_s_variable(monkeypatch):
    monkeypatch.setenv(BACKEND_VARIABLE, "77")
    found = Gpu("0")
    assert found.info["device"] == 0
    found.close()
    assert os.environ[BACKEND_VARIABLE] == "77"


def test_a_named_device_asks_for_gl(monkeypatch):
    monkeypatch.setenv(GL_DEVICE_VARIABLE, "0")
    with ExitStack() as closing:
        found = [open_engine(choice, closing) for choice in ("auto", "native")]
        assert [(one.name, one.reason) for one in found] == [
            ("gl", "a device is selected"),
            ("native", "as requested"),
        ]


def test_names_are_asked_for_where_the_device_has_them():
    texts = {0x3055: NAME_EXTENSION.encode(), 0x3053: b"NVIDIA", 0x335F: b"H100"}
    assert str(_described(3, texts.get)) == "3 (NVIDIA H100)"
    assert str(_described(0, {0x3055: SOFTWARE_EXTENSION.encode()}.get)) == (
        "0 (software)"
    )
    assert str(_described(1, lambda what: None)) == "1 (unnamed)"
