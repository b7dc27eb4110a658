"""The first lines of each way to use ocufilter run, in the suite with what it needs."""

import ast
import configparser
import contextlib
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time

import pytest

from clients import pyrender_stream
from clients.filter_client import FilterClient
from filter_service import service as service_package
from filter_service.errors import FilterError
from tests.commands import run_command, run_main, with_arguments
from tests.end_to_end.conftest import START_TIMEOUT_S, TIMEOUT_S
from tests.page_commands import ENDPOINT, make_files, ways_in
from tests.source_tree import ROOT

HERE = "tests/end_to_end"
WAYS_IN = f"{HERE}/test_ways_in.py"
PYTHON_EXAMPLES = f"{HERE}/test_documentation.py::test_the_examples_of_a_page_run"
COPIES = f"{HERE}/test_wheel.py::test_files_of_the_package_are_where_pages_say"
TESTS_OF = {
    "Wheel": (f"{HERE}/test_wheel.py::test_the_printed_lines_install_the_wheel",),
    "Clone with a compiler": ("make demo",),
    "Clone without a compiler": (
        "tests/unit/test_setup_permission.py"
        "::test_after_a_refusal_optional_packages_are_named_without_a_question",
        "tests/unit/test_setup.py"
        "::test_without_a_compiler_the_build_asks_for_that_of_pypi",
    ),
    "Commands": (f"{HERE}/test_page_commands.py::test_a_command_runs_as_printed",),
    "Batch": (f"{WAYS_IN}::test_batches_and_reports_are_written",),
    "Report": (f"{WAYS_IN}::test_batches_and_reports_are_written",),
    "Web page": (
        "tests/web/test_page.py::test_another_prescription_changes_the_picture",
    ),
    "Python": (PYTHON_EXAMPLES,),
    "Notebook": (
        "tests/examples/test_notebook.py"
        "::test_the_notebook_runs_and_makes_its_pictures",
    ),
    "PyTorch": (
        "tests/training/test_see_through.py::test_the_lines_of_the_page_of_ways_run",
    ),
    "PsychoPy": (
        f"{HERE}/test_adapters.py::test_the_lines_of_the_page_show_a_stimulus",
        f"{HERE}/test_wheel.py::test_the_adapters_install_where_the_wheel_is",
    ),
    "Service": (f"{WAYS_IN}::test_a_service_starts_and_replies", PYTHON_EXAMPLES),
    "JavaScript": (
        COPIES,
        f"{HERE}/test_javascript.py::test_the_example_of_a_page_runs",
    ),
    "C++": (
        COPIES,
        f"{HERE}/test_cpp.py::test_the_example_runs_as_its_comment_says",
        f"{HERE}/test_cpp.py::test_the_lines_of_the_pages_run",
    ),
    "pyrender": (f"{WAYS_IN}::test_pyrender_streams_a_file",),
    "OpenXR": (
        "tests/headset/test_viewer.py::test_the_printed_line_shows_a_scene",
        "tests/openxr_layer/test_layer_monado.py::test_the_printed_lines_filter_hello_xr",
    ),
    "Container": (
        "tests/headset/test_container.py::test_the_steps_of_the_image_make_a_service",
        f"{HERE}/test_operations.py::test_the_container_holds_what_a_machine_needs",
    ),
    "systemd": (COPIES, f"{WAYS_IN}::test_the_commands_of_the_unit_run_a_service"),
}
"""Tests that run the lines of each way; `make demo` is a suite of its own."""


def functions_of(path):
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_each_way_has_tests():
    assert set(TESTS_OF) == set(ways_in()) - {"Install"}
    suites = re.search(r"^SUITES=\((.*)\)", (ROOT / ".ci/run").read_text(), re.M)[1]
    for test in {name for names in TESTS_OF.values() for name in names}:
        path, _, function = test.partition("::")
        if function:
            assert function in functions_of(path), test
        else:
            assert test.removeprefix("make ") in suites.split(), test


def wait_until_ready(endpoint):
    end_s = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            with FilterClient(endpoint, timeout_s=1.0) as client:
                return client.ping()
        except FilterError:
            assert time.monotonic() < end_s, f"no service at {endpoint}"


@pytest.fixture
def endpoint():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{unused.getsockname()[1]}"


@contextlib.contextmanager
def running(words, **variables):
    """Run a program until the end of the block, which SIGTERM ends cleanly."""
    own = f"{os.path.dirname(sys.executable)}:{os.environ['PATH']}"
    with subprocess.Popen(
        words, env=os.environ | {"PATH": own} | variables, stderr=subprocess.PIPE
    ) as program:
        try:
            yield program
            program.send_signal(signal.SIGTERM)
            _, said = program.communicate(timeout=TIMEOUT_S)
        finally:
            program.kill()
    assert program.returncode == 0, said


@pytest.mark.clients
@pytest.mark.long("computes a report, and starts the worker of a batch")
@pytest.mark.parametrize(
    "command", [*ways_in()["Batch"], *ways_in()["Report"]], ids=str
)
def test_batches_and_reports_are_written(command, tmp_path):
    make_files(tmp_path)
    finished = run_command(*command.arguments, cwd=tmp_path)
    command.check(finished.returncode, finished.stderr, may_lack=False)
    written = tmp_path / command.words[command.words.index("-o") + 1]
    if written.is_dir():
        assert list(written.rglob("*.png"))
    else:
        begins = {".html": b"<!DOCTYPE html>", ".pdf": b"%PDF-"}[written.suffix]
        assert written.read_bytes().startswith(begins)


@pytest.mark.clients
@pytest.mark.long("starts a service")
def test_a_service_starts_and_replies(endpoint, tmp_path):
    serve, status = ways_in()["Service"]
    assert serve.words == ["ocufilter", "serve", "&"]
    with running(["ocufilter", "serve", "--bind", endpoint]):
        wait_until_ready(endpoint)
        words = [endpoint if word == ENDPOINT else word for word in status.arguments]
        finished = run_command(*words, cwd=tmp_path)
        status.check(finished.returncode, finished.stderr, may_lack=False)
        assert "native" in finished.stdout


@pytest.mark.clients
@pytest.mark.long("computes two eyes for a stream")
def test_pyrender_streams_a_file(real_service, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((0.5, 0.9, 0.5)).export(tmp_path / "chair.glb")
    _, stream = ways_in()["pyrender"]
    assert stream.words[:3] == ["python", "-m", "clients.pyrender_stream"]
    finished = run_main(
        with_arguments(pyrender_stream.main),
        *(*stream.words[3:], "--endpoint", real_service.endpoint),
        *("--size", "64x36", "--frames", "4", "--json"),
        cwd=tmp_path,
    )
    stream.check(finished.returncode, finished.stderr, may_lack=False)
    assert '"sent": 4' in finished.stdout


@pytest.mark.clients
@pytest.mark.long("starts a service")
def test_the_commands_of_the_unit_run_a_service(endpoint, tmp_path):
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(f"{service_package.__path__[0]}/ocufilter.service")
    words = {
        name: shlex.split(unit["Service"][name].replace("%E", str(tmp_path)))
        for name in ("ExecStartPre", "ExecStart", "ExecReload")
    }
    (tmp_path / "ocufilter").mkdir()  # systemd does so for ConfigurationDirectory
    config = tmp_path / "ocufilter" / "service.toml"
    subprocess.run(words["ExecStartPre"], check=True)
    assert config.read_text(encoding="utf-8") == ""
    config.write_text(f'bind = "{endpoint}"\n', encoding="utf-8")
    subprocess.run(words["ExecStartPre"], check=True)  # which keeps the file
    with running(words["ExecStart"]) as program:
        wait_until_ready(endpoint)
        own = os.environ | {"MAINPID": str(program.pid)}
        subprocess.run(words["ExecReload"], check=True, env=own)
        wait_until_ready(endpoint)
