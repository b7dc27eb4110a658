"""Number of threads of this process."""

import os

import pytest

from estimator import threads


@pytest.fixture(autouse=True)
def asked_anew(monkeypatch):
    monkeypatch.delenv(threads.THREADS_VARIABLE, raising=False)
    threads.thread_count.cache_clear()
    yield
    threads.thread_count.cache_clear()


def test_threads_are_the_cores_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(threads, "_quota_cores", lambda folder: 256)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)))
    assert threads.thread_count() == 16


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu.max": "max 100000\n"}, 256),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 256),
        ({}, 256),
    ],
)
def test_a_containers_quota_caps_them(tmp_path, monkeypatch, files, cores):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert threads._quota_cores(tmp_path) == cores
    monkeypatch.setattr(threads, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)))
    assert threads.thread_count() == min(cores, 64)


def test_a_setting_says_another_number(monkeypatch):
    monkeypatch.setenv(threads.THREADS_VARIABLE, "3")
    assert threads.thread_count() == 3
    for wrong in ("0", "many", "-2", "1000"):
        monkeypatch.setenv(threads.THREADS_VARIABLE, wrong)
        threads.thread_count.cache_clear()
        with pytest.raises(ValueError, match="1 to 256"):
            threads.thread_count()
