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


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu.max": "6400000 100000\n"}, 16),
        ({"cpu.max": "max 100000\n"}, 16),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 16),
        ({}, 16),
    ],
)
def test_threads_are_the_usable_cores_up_to_a_containers_quota(
    tmp_path, monkeypatch, files, cores
):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(threads, "_CGROUP", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)))
    assert threads.thread_count() == cores


def test_a_setting_says_another_number(monkeypatch):
    monkeypatch.setenv(threads.THREADS_VARIABLE, "3")
    assert threads.thread_count() == 3
    for wrong in ("0", "many", "-2", "1000"):
        monkeypatch.setenv(threads.THREADS_VARIABLE, wrong)
        threads.thread_count.cache_clear()
        with pytest.raises(ValueError, match="1 to 256"):
            threads.thread_count()
