"""The service's settings: defaults, files, and every refusal by name."""

from pathlib import Path

import pytest

from filter_service.service.config import ServiceConfig, default_cache_dir, load_config


def test_the_defaults_listen_on_loopback_only():
    config = load_config()
    assert config.bind == "tcp://127.0.0.1:5577"
    assert config.limits.max_part_bytes == 100_000_000
    assert config.max_message_part_bytes == 100_000_000


def test_a_file_is_read_and_the_command_line_wins(tmp_path):
    path = tmp_path / "service.toml"
    path.write_text('bind = "tcp://127.0.0.1:1"\ncredit = 3\nalive_interval_s = 2\n')
    config = load_config(path, bind="tcp://localhost:*", ready_file=None)
    assert (config.bind, config.credit) == ("tcp://localhost:*", 3)
    assert config.alive_interval_s == 2.0


def test_the_ready_file_becomes_a_path(tmp_path):
    assert load_config(ready_file=str(tmp_path / "r")).ready_file == tmp_path / "r"


@pytest.mark.parametrize(
    "bind",
    [
        "tcp://0.0.0.0:5577",
        "tcp://*:5577",
        "tcp://192.168.1.5:5577",
        "tcp://[::]:5577",
        "tcp://eth0:5577",
    ],
)
def test_other_interfaces_are_refused_with_the_way_out(bind):
    with pytest.raises(ValueError, match="SSH") as caught:
        ServiceConfig(bind=bind)
    assert "ocufilter keys add" in str(caught.value)
    assert ServiceConfig(bind=bind, keys_dir="keys").bind == bind


@pytest.mark.parametrize(
    "bind", ["", "5577", "tcp://", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "ipc://"]
)
def test_endpoints_that_cannot_work_are_refused(bind):
    with pytest.raises(ValueError, match="bind is"):
        ServiceConfig(bind=bind)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("credit", 0),
        ("max_views", 9),
        ("max_profile_kb", 2000),
        ("cancel_grace_s", 0.0),
    ],
)
def test_values_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; allowed"):
        ServiceConfig(**{name: value})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed = 3", "unknown setting 'speed'"),
        ("psf_engine = 'cpu'", "psf_engine was removed: .* delete the setting"),
        ("credit = 2.5", "credit is 2.5; allowed: int"),
        ("credit = true", "credit is True; allowed: int"),
        ("bind = 5577", "bind is 5577; allowed: str"),
        ("ready_file = 3", "ready_file is 3; allowed: str"),
        ("credit = ", "not TOML"),
        ("a = " + "[" * 5000, r"--config.*not TOML \(maximum recursion depth"),
        ("alive_interval_s = " + "9" * 400, "alive_interval_s is 9+; allowed: float"),
    ],
)
def test_wrong_files_are_refused_by_name(tmp_path, text, message):
    path = Path(tmp_path / "service.toml")
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_config(path)


def test_stores_are_kept_where_the_user_says_and_builds_know_it(monkeypatch):
    monkeypatch.delenv("OCUFILTER_CACHE_DIR")
    assert default_cache_dir() == "", "nobody has asked for it"
    monkeypatch.setenv("OCUFILTER_CACHE_DIR", "/somewhere")
    assert default_cache_dir() == "/somewhere"
    config = load_config(store_cache_dir="/mine", store_cache_max_mb=7, max_store_mb=9)
    limits = config.build_limits
    assert (limits.store_cache_dir, limits.store_cache_max_mb) == ("/mine", 7)
    assert limits.max_store_mb == 9
