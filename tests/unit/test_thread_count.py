"""Number of threads of this process."""

import multiprocessing
import os
import sys

import pytest

from estimator import threads
from estimator.native import core, shared_threads
from estimator.psf.compiled import compiled_psfs

linux = pytest.mark.skipif(sys.platform != "linux", reason="forks")


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


def send_counts(sender):
    """Send the numbers of threads of settings, of C loops, and of PSFs (a child)."""
    handles = shared_threads(), compiled_psfs().threads
    sender.send([threads.thread_count(), *map(core().thread_count, handles)])


def counts_of_child(method):
    context = multiprocessing.get_context(method)
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=send_counts, args=(sender,))
    child.start()
    found = receiver.recv()
    child.join()
    return found


@linux
@pytest.mark.parametrize(
    "method",
    ["fork", pytest.param("spawn", marks=pytest.mark.long("starts an interpreter"))],
)
def test_processes_of_multiprocessing_use_one_thread(monkeypatch, method):
    """Even if they were forked from one that uses more, unless a variable says so."""
    shared_threads(), compiled_psfs()
    threads.thread_count.cache_clear()
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(3)))
    assert threads.thread_count() > 1 or threads._quota_cores(threads._CGROUP) == 1
    assert counts_of_child(method) == [1, 1, 1]
    monkeypatch.setenv(threads.THREADS_VARIABLE, "2")
    assert counts_of_child(method) == [2, 2, 2]
