"""Devices as the settings name them, and which of them is the least busy."""

import pytest

from estimator.threads import thread_count
from filter_service.messages import DeviceState, Pong, encode
from filter_service.service.config import ServiceConfig, load_config
from filter_service.service.frame_queue import LOAD_WINDOW_S, Load
from filter_service.wire.message import MAX_DEVICES, MAX_HEADER_BYTES


def test_without_devices_the_one_process_has_the_settings_as_they_are():
    config = ServiceConfig(engine="native", threads=3)
    assert config.device_names == ("native",)
    assert config.for_device(0) is config


def test_each_device_has_its_engine_its_threads_and_its_gpu():
    names = ("native:3", "native", "gl:1", "gl", "auto")
    config = ServiceConfig(devices=names, threads=10)
    assert config.device_names == names
    found = [config.for_device(index) for index in range(len(names))]
    assert [(c.engine, c.threads, c.gl_device) for c in found] == [
        ("native", 3, "auto"),
        ("native", 2, "auto"),
        ("gl", 2, "1"),
        ("gl", 2, "auto"),
        ("auto", 2, "auto"),
    ]
    assert all(not c.devices for c in found)


def test_threads_are_shared_and_each_has_one_at_least():
    config = ServiceConfig(devices=("native",) * 2)
    assert config.for_device(1).threads == max(1, thread_count() // 2)
    config = ServiceConfig(devices=("native",) * 8, threads=1)
    assert config.for_device(7).threads == 1


@pytest.mark.parametrize(
    "wrong",
    ["", "cuda", "native:", "native:0", "native:x", "native:999", "auto:1", "gl:-1"],
)
def test_what_is_no_device_is_refused(wrong):
    with pytest.raises(
        ValueError, match=f"unknown device {wrong!r} in devices; allowed: up to 8"
    ):
        ServiceConfig(devices=("native", wrong))


def test_too_many_and_engines_told_twice_are_refused():
    with pytest.raises(ValueError, match="devices has 9 items; allowed: up to 8"):
        ServiceConfig(devices=("native",) * 9)
    for name, value in (("engine", "gl"), ("gl_device", "1")):
        with pytest.raises(
            ValueError, match=f"{name} is '{value}', but devices select"
        ):
            ServiceConfig(devices=("native",), **{name: value})


def test_files_have_a_list_and_the_command_line_commas(tmp_path):
    path = tmp_path / "service.toml"
    path.write_text('devices = ["gl:0", "gl:1"]\n')
    assert load_config(path).devices == ("gl:0", "gl:1")
    assert load_config(path, devices="native:1, auto").devices == ("native:1", "auto")
    path.write_text("devices = [1]\n")
    with pytest.raises(
        ValueError, match=r"devices is \[1\]; allowed: a list of strings"
    ):
        load_config(path)
    path.write_text("devices = 3\n")
    with pytest.raises(ValueError, match="devices is 3; allowed: a list of strings"):
        load_config(path)


def test_load_is_of_the_last_seconds():
    load = Load()
    assert load.busy_ratio(100.0) == 0.0
    for second in range(1000):  # half of each is used
        load.add(0.5, 100.0 + second)
    busy = load.busy_ratio(1099.0)
    assert busy == pytest.approx(0.5, abs=0.03)
    later = load.busy_ratio(1099.0 + LOAD_WINDOW_S)
    assert later == pytest.approx(busy / 2.718, rel=1e-3)
    load.add(1000.0, 1100.0)
    assert load.busy_ratio(1100.0) == 1.0


def test_a_pong_of_all_devices_fits_into_a_header():
    large = 2**53 - 1
    device = DeviceState(
        *("native:256", "x" * 1000, large, 0.123456789, large, 123456.7),
        render_silent_s=0.123456789,
    )
    pong = Pong(1.5, 1.5, 1.5, large, large, large, devices=(device,) * MAX_DEVICES)
    header, *_ = encode(pong)
    assert len(header) <= MAX_HEADER_BYTES
