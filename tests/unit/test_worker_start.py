"""Where the worker process imports from: where this one does, and nowhere else."""

import socket
import sys
import time
from pathlib import Path

from filter_service.building.worker_handle import WorkerHandle
from tests.source_tree import ROOT


def gets_ready():
    worker = WorkerHandle("tests.end_to_end.doubles:build", warm_up="")
    worker.start()
    deadline_s = time.monotonic() + 20.0
    try:
        while not worker._is_ready and not worker.n_restarts:
            assert time.monotonic() < deadline_s
            worker.poll()
            time.sleep(0.02)
        return not worker.n_restarts
    finally:
        worker.close()


def test_a_file_of_the_current_folder_is_not_taken_for_a_module(tmp_path, monkeypatch):
    (tmp_path / "estimator.py").write_text("raise SystemExit('not ours')\n")
    monkeypatch.chdir(tmp_path)
    elsewhere = [entry for entry in sys.path if entry]
    monkeypatch.setattr(sys, "path", [str(ROOT), *elsewhere])
    assert gets_ready()


def test_an_entry_of_the_path_that_is_no_text_is_skipped_as_imports_skip_it(
    monkeypatch,
):
    monkeypatch.setattr(sys, "path", [*sys.path, Path("anywhere")])
    assert gets_ready()


def test_a_default_timeout_of_sockets_does_not_end_the_worker():
    """Such as PsychoPy sets: sockets are then not blocking, on both ends of a pair."""
    socket.setdefaulttimeout(5.0)
    try:
        worker = WorkerHandle("tests.end_to_end.doubles:build", warm_up="")
        worker.start()
        end_s = time.monotonic() + 3.0
        while time.monotonic() < end_s:
            worker.poll()
            time.sleep(0.02)
        assert worker._is_ready
        assert not worker.n_restarts
        worker.close()
    finally:
        socket.setdefaulttimeout(None)
