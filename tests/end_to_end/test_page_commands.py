"""Commands of the pages and of help texts: read by the programs, or run as printed."""

import importlib.util
import re
import shlex
import subprocess
import tomllib
from importlib.metadata import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from typer.core import TyperCommand

from clients import pyrender_stream
from filter_service.service.config import load_config
from filter_service.version import __version__
from tests.commands import run_command, run_main, with_arguments
from tests.end_to_end.printed_script import printed_by
from tests.page_commands import (
    ENDPOINT,
    PAGES,
    SLOW,
    commands_of,
    commands_of_help,
    make_files,
)
from tests.source_tree import ROOT

pytestmark = pytest.mark.clients

OF_PAGES = [command for page in PAGES for command in commands_of(page)]
INLINE = r"`((?:ocufilter|python|pip|make|sh|bash|node|npm) [^`]*)`"
OF_SYSTEM = {
    *("apt", "apt-get", "cd", "cp", "debootstrap", "env", "g++", "git", "install"),
    "ln",
    *("node", "npm", "podman", "runuser", "sha256sum", "source", "sudo", "systemctl"),
    *("useradd", "the-program"),
}
"""Programs that are not this project's: only what they get from it is checked."""


def test_pages_have_commands_of_each_kind():
    programs = {Path(shlex.split(c.text)[0]).name for c in OF_PAGES}
    assert {"ocufilter", "make", "python", "pip", "sh", "systemctl"} <= programs
    assert len([c for c in OF_PAGES if c.arguments is not None]) > 40
    assert len(commands_of_help()) > 30


@pytest.fixture
def read(monkeypatch, tmp_path):
    """Run `ocufilter` until its arguments are read and checked."""
    monkeypatch.setattr(TyperCommand, "invoke", lambda command, context: None)
    return lambda arguments: run_command(*arguments, cwd=tmp_path)


def arguments_once(commands):
    """The first of the commands that have the same arguments of `ocufilter`."""
    found = {}
    for command in commands:
        if command.arguments is not None:
            found.setdefault(tuple(command.arguments), command)
    return found.values()


@pytest.mark.parametrize(
    "command", arguments_once([*OF_PAGES, *commands_of_help()]), ids=str
)
def test_the_program_reads_the_arguments(read, command):
    finished = read(command.arguments)
    assert finished.returncode == 0, (command.text, finished.stderr)


@pytest.mark.parametrize(
    "command",
    [
        command
        for command in (*OF_PAGES, *commands_of_help())
        if command.text.startswith("python -m clients.pyrender_stream ")
    ],
    ids=str,
)
def test_the_streaming_program_reads_the_arguments(read, command, tmp_path):
    finished = run_main(
        with_arguments(pyrender_stream.main), *command.words[3:], cwd=tmp_path
    )
    assert finished.returncode == 0, (command.text, finished.stderr)


@pytest.mark.parametrize(
    "arguments",
    [
        *("filter photo.jpg", "headset --no-such 1", "layer fly", "report --no-such x"),
        *("web --port x", "no-such", "keys add", "batch --no-such 1", "field --people"),
    ],
)
def test_the_program_refuses_other_arguments(read, arguments):
    assert read(arguments.split()).returncode == 2


def check_requirement(text):
    """A package of this project's requirements, with extras that exist."""
    requirement = Requirement(text)
    ours = metadata("ocufilter")
    if requirement.name == "ocufilter":
        assert requirement.extras <= set(ours.get_all("Provides-Extra")), text
    elif not (ROOT / "constraints.txt").read_text("utf-8").count(f"{text}=="):
        names = {Requirement(r).name.lower() for r in ours.get_all("Requires-Dist")}
        assert requirement.name.lower() in {*names, "pyopengl", *OTHER_PACKAGES}, text


OTHER_PACKAGES = {"pre-commit", "pyvirtualcam", "jupyterlab"}
"""Packages that pages name and the project does not require."""


def check_pip(arguments):
    assert arguments[0] == "install"
    skip = False
    for word, value in zip(arguments[1:], [*arguments[2:], ""], strict=True):
        if skip:
            skip = False
        elif word == "-c":
            assert (ROOT / value).is_file()
            skip = True
        elif ".whl" in word:
            assert f"ocufilter-{__version__}-" in word, "of another version"
            *_, extras = re.fullmatch(r"(.*\.whl)(?:\[(.*)\])?", word).groups()
            check_requirement(f"ocufilter[{extras}]" if extras else "ocufilter")
        elif word.startswith(("-", ".")):
            continue
        elif "/" in word:
            assert (ROOT / word / "pyproject.toml").is_file(), word
        else:
            check_requirement(word)


def check_module(module, arguments):
    if module == "pip":
        check_pip(arguments)
    elif module not in ("venv", "pytest", "jupyterlab", "mkdocs"):
        assert importlib.util.find_spec(module) is not None, module
    for word in arguments:
        if module != "venv" and word.endswith((".py", ".toml", ".ipynb")):
            assert list(ROOT.glob(word)), word


def check_program(words):
    program, arguments = Path(words[0]).name, words[1:]
    if program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        target = next(word for word in arguments if "=" not in word)
        assert re.search(rf"^{target}:", makefile, re.M), target
    elif program == "pip":
        check_pip(arguments)
    elif program.startswith("python") and arguments[0] == "-m":
        check_module(arguments[1], arguments[2:])
    elif program.startswith("python") and arguments[0] != "-c":
        assert arguments[0].startswith("-W") or (ROOT / arguments[0]).is_file()
    elif program in ("sh", "bash"):
        script = arguments[0].replace("gpu_kit/", "tests/gpu_kit/")
        assert (ROOT / script).is_file(), script
        if script == "setup.sh" and arguments[1:]:
            usage = (ROOT / script).read_text(encoding="utf-8")
            assert f"#   sh setup.sh {arguments[1]} " in usage
    elif program not in ("ocufilter", "python", "python3"):
        assert program in OF_SYSTEM, program


def simple_commands(text):
    """Words of the commands that `&&` joins, without variables and `sudo`."""
    for part in text.split(" && "):
        words = shlex.split(re.sub(r"^\w+=\$\((.*)\).*", r"\1", part))
        while words and re.fullmatch(r"\w+=.*", words[0]):
            words = words[1:]
        yield words[1:] if words[:1] == ["sudo"] else words


@pytest.mark.parametrize("page", [page for page in PAGES if commands_of(page)])
def test_other_programs_and_what_they_read_exist(page):
    for command in commands_of(page):
        for words in simple_commands(command.text):
            if words:
                check_program(words)
        for version in re.findall(r"ocufilter-(\d+\.\d+\.\d+)", command.text):
            assert version == __version__, command
    script = "\n".join(command.text for command in commands_of(page))
    subprocess.run(["sh", "-n"], input=script, text=True, check=True)


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_sentences_exist(page, read):
    text = (ROOT / page).read_text(encoding="utf-8")
    for inline in re.findall(INLINE, text):
        words = " ".join(inline.split()).replace("'", "").split()
        if words[0] == "ocufilter":
            known = read([*words[1:2], "--help"])
            assert known.returncode == 0, inline
            options = {word.partition("=")[0] for word in words if word[:2] == "--"}
            shown = re.split(
                r"[\s,]", known.stdout + read([*words[1:3], "--help"]).stdout
            )
            assert words[1] == "bench" or options <= {*shown, "--version"}, inline
        elif words[0] not in ("node", "npm"):
            check_program(words)


@pytest.mark.parametrize(
    "page", [p for p in PAGES if "```toml" in (ROOT / p).read_text(encoding="utf-8")]
)
def test_configurations_that_pages_show_are_read(page, tmp_path):
    text = (ROOT / page).read_text(encoding="utf-8")
    for indent, block in re.findall(r"^( *)```toml\n(.*?)```", text, re.M | re.S):
        path = tmp_path / "service.toml"
        path.write_text(re.sub(rf"^{indent}", "", block, flags=re.M), encoding="utf-8")
        config = load_config(path)
        for name, value in tomllib.loads(path.read_text("utf-8")).items():
            assert str(getattr(config, name)) == str(value)


# Commands that run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the files that commands read; commands of a page share results."""
    folder = tmp_path_factory.mktemp("pages")
    make_files(folder)
    return folder


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(c, marks=[pytest.mark.slow] if c.is_one_of(SLOW) else [])
        for c in arguments_once(c for c in OF_PAGES if c.ends)
        if c.arguments[0] != "keys"
    ],
    ids=str,
)
def test_a_command_runs_as_printed(command, folder, request):
    words = command.arguments
    if ENDPOINT in words:
        service = request.getfixturevalue("real_service")
        words = [service.endpoint if word == ENDPOINT else word for word in words]
    home = {"HOME": str(folder), "XDG_DATA_HOME": str(folder / "data")}
    finished = run_command(*words, cwd=folder, **home)
    command.check(finished.returncode, finished.stderr, may_lack=words[0] == "layer")
    for option in ("-o", "--out", "--plot"):
        if option in words:
            assert (folder / words[words.index(option) + 1]).exists()


def test_keys_are_added_listed_and_removed_as_printed(tmp_path):
    for command in commands_of("docs/how-to/deploy.md"):
        words = command.arguments or [""]
        if words[0] == "keys":
            home = {"XDG_CONFIG_HOME": str(tmp_path)}
            finished = run_command(*words, cwd=tmp_path, **home)
            command.check(finished.returncode, finished.stderr, may_lack=False)
            if words[1] == "list":
                assert "lab" in finished.stdout
    assert (tmp_path / "lab.toml").exists()


def test_the_folder_of_the_javascript_client_is_printed(tmp_path):
    (command,) = (
        command
        for command in commands_of("docs/how-to/game-engine.md")
        if command.text.startswith("python -c")
    )
    folder = Path(printed_by(*command.words[1:], cwd=tmp_path).strip())
    assert (folder / "filter_client.js").samefile(ROOT / "clients/js/filter_client.js")
