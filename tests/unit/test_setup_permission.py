"""Set-up scripts run sudo with permission only, and name what is missing without it."""

import os
import pty
import re
import shutil
import subprocess

import pytest

from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

PROGRAMS = {
    "id": 'echo "$FAKE_UID"',
    "sudo": 'echo "sudo $*" >>"$LOG"',
    "apt-get": 'echo "apt-get $*" >>"$LOG"',
    "env": """case "$*" in *apt-get*) echo "env $*" >>"$LOG" ;;
*) exec /usr/bin/env "$@" ;; esac""",
    "dpkg-query": """for package in "$@"; do :; done # the last argument
case " $MISSING " in *" $package "*) ;; *) echo "install ok installed" ;; esac""",
    "cc": "exit 0",
    "npm": "mkdir -p node_modules",
    # makes an environment whose Python is this script
    "python3": """case "$*" in *venv*)
    for folder in "$@"; do :; done
    mkdir -p "$folder/bin"; cp "$0" "$folder/bin/python" ;; esac""",
}
"""Stand-ins on PATH: they write what would change the system to $LOG."""

SETUP_INPUTS = (
    "setup.py",
    "pyproject.toml",
    "constraints.txt",
    "filter_service/native/source/a.c",
    "filter_service/service/a.c",
    "clients/js/package.json",
)
COMMAND = "sudo apt-get update && sudo apt-get install -y"
USER, SUPERUSER = "1000", "0"


@pytest.fixture
def checkout(tmp_path):
    """Return a folder with the set-up scripts and empty sources."""
    folder = tmp_path / "checkout"
    for name in SETUP_INPUTS:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    for name in (
        "setup.sh",
        "ask_sudo.sh",
        "tests/headset/setup_root.sh",
        "tests/headset/run_in_root.sh",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    for name, text in PROGRAMS.items():
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
        path.chmod(0o755)
    return folder


@pytest.fixture
def run(checkout):
    """Return how to run a script; its result has ``system``, the lines of the log."""

    def run(*command, uid=USER, missing="", answer=None, **variables):
        log = checkout.parent / "log"
        log.write_text("")
        environment = {k: v for k, v in os.environ.items() if "OCUFILTER" not in k}
        environment |= {
            "PATH": f"{checkout.parent}/bin:{os.environ['PATH']}",
            "LOG": str(log),
            "FAKE_UID": uid,
            "MISSING": missing,
            **variables,
        }
        inputs = [subprocess.DEVNULL]
        if answer is not None:  # typed on a terminal
            ours, theirs = pty.openpty()
            os.write(ours, answer.encode())
            inputs = [theirs, ours]
        finished = subprocess.run(
            ["sh", *command],
            cwd=checkout,
            env=environment,
            stdin=inputs[0],
            capture_output=True,
            text=True,
            timeout=60,
        )
        for descriptor in inputs if answer is not None else ():
            os.close(descriptor)
        finished.system = log.read_text().splitlines()
        return finished

    return run


@pytest.mark.parametrize("kind", [(), ("test",)])
def test_without_missing_packages_nothing_is_asked_and_sudo_does_not_run(run, kind):
    for arguments in (kind, ("--yes", *kind)):
        finished = run("setup.sh", *arguments, answer="")
        assert finished.returncode == 0, finished.stderr
        assert finished.system == []
        assert "[y/N]" not in finished.stderr


def test_without_a_terminal_the_missing_package_is_named_with_the_command(run):
    finished = run("setup.sh", missing="libegl1 libgl1")
    assert finished.returncode == 1
    assert "missing system packages: libegl1 libgl1\n" in finished.stderr
    assert f"{COMMAND} libegl1 libgl1\n" in finished.stderr
    assert finished.system == []


def test_packages_for_reports_are_optional(run):
    finished = run("setup.sh", missing="libpango-1.0-0")
    assert finished.returncode == 0, finished.stderr
    assert f"no reports as PDF without libpango-1.0-0; to install:  {COMMAND}" in (
        finished.stderr
    )
    assert finished.system == []


@pytest.mark.parametrize(
    ("arguments", "variables"),
    [(("--yes",), {}), ((), {"OCUFILTER_SETUP_YES": "1"}), (("test", "--yes"), {})],
)
def test_with_permission_sudo_runs_and_never_waits_for_a_password(
    run, arguments, variables
):
    finished = run("setup.sh", *arguments, missing="libegl1", **variables)
    assert finished.returncode == 0, finished.stderr
    assert finished.system == [
        "sudo -n apt-get update",
        "sudo -n env DEBIAN_FRONTEND=noninteractive apt-get install -y "
        "--no-install-recommends libegl1",
    ]


def test_another_value_of_the_variable_is_no_permission(run):
    finished = run("setup.sh", missing="libegl1", OCUFILTER_SETUP_YES="0")
    assert finished.returncode == 1
    assert finished.system == []


def test_on_a_terminal_the_script_asks_with_the_command(run):
    finished = run("setup.sh", missing="libegl1", answer="y\n")
    assert finished.returncode == 0, finished.stderr
    assert f"run this command?  {COMMAND} libegl1  [y/N]" in finished.stderr
    assert [line[:20] for line in finished.system] == [
        "sudo apt-get update",
        "sudo env DEBIAN_FRON",
    ]


@pytest.mark.parametrize("answer", ["n\n", "\n", "yes please\n"])
def test_any_other_answer_refuses(run, answer):
    finished = run("setup.sh", missing="libegl1", answer=answer)
    assert finished.returncode == 1
    assert f"run this again:  {COMMAND} libegl1\n" in finished.stderr
    assert finished.system == []


def test_after_a_refusal_optional_packages_are_named_without_a_question(run, checkout):
    (checkout.parent / "bin/cc").write_text("#!/bin/sh\nexit 1\n")
    finished = run("setup.sh", "test", missing="xvfb", answer="n\n")
    assert finished.returncode == 0
    assert finished.stderr.count("[y/N]") == 1
    assert f"{COMMAND} gcc libc6-dev\n" in finished.stderr
    assert f"{COMMAND} xvfb\n" in finished.stderr
    assert finished.system == []


def test_root_installs_without_sudo(run):
    finished = run("setup.sh", missing="libegl1", uid=SUPERUSER)
    assert finished.returncode == 0, finished.stderr
    assert [line.split()[0] for line in finished.system] == ["apt-get", "env"]
    assert "[y/N]" not in finished.stderr


def test_the_headset_root_asks_too(run, tmp_path):
    script, root = "tests/headset/setup_root.sh", str(tmp_path / "root")
    finished = run(script, root)
    assert finished.returncode == 77
    assert f"setup_root.sh {root}\n" in finished.stderr
    assert "run:  sudo --preserve-env sh " in finished.stderr
    assert finished.system == []
    assert run(script, root, answer="n\n").system == []
    for finished in (
        run(script, "--yes", "--applications", root),
        run(script, "--applications", root, OCUFILTER_SETUP_YES="1"),
    ):
        assert finished.returncode == 0, finished.stderr
        (line,) = finished.system
        assert re.fullmatch(
            f"sudo -n --preserve-env sh .*/{script} --applications {root}", line
        )


def test_commands_in_the_headset_root_ask_too(run, tmp_path):
    (tmp_path / "root/bin").mkdir(parents=True)
    shutil.copy(tmp_path / "bin/cc", tmp_path / "root/bin/sh")
    command = ("tests/headset/run_in_root.sh", "true")
    root = {"HEADSET_ROOT": str(tmp_path / "root")}
    finished = run(*command, **root)
    assert finished.returncode == 77
    assert "requires root; run: sudo " in finished.stderr
    assert finished.system == []
    finished = run(*command, **root, answer="y\n")
    assert finished.system[0].startswith("sudo unshare --mount --net sh ")


def test_no_other_script_runs_sudo():
    named = subprocess.run(
        ["git", "ls-files", "*.sh", ".ci/run", "Makefile"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    comment_or_text = re.compile(r"^ *#.*$|\"[^\"\n]*\"", re.MULTILINE)
    sudo = re.compile(r"\bsudo\b")
    texts = {n: (ROOT / n).read_text(encoding="utf-8") for n in named}
    found = {n for n, t in texts.items() if sudo.search(comment_or_text.sub("", t))}
    assert found == {"ask_sudo.sh"}
