"""The README's commands, links, presets and settings are those that exist."""

import json
import re
import shlex

import pytest
from typer.testing import CliRunner

from estimator.profiles.parse import parse_profile, preset_names
from filter_service.__main__ import app
from tests.source_tree import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
LIVE = json.loads(
    (ROOT / "tests/benchmarks/results/live.json").read_text(encoding="utf-8")
)
ROW_OF_EYE = {
    "emmetropia": "emmetropia",
    "myopia": "myopia, -6 dpt",
    "astigmatism": "astigmatism",
    "keratoconus": "keratoconus",
    "cataract": "cataract",
    "post_lasik": "after LASIK",
}


def _make_targets() -> set[str]:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    return set(re.findall(r"^([a-z][a-z-]*):", makefile, re.MULTILINE))


def _indented_commands(program: str) -> list[list[str]]:
    lines = re.findall(rf"^    ({program} .*)$", README, re.MULTILINE)
    return [shlex.split(line, comments=True)[1:] for line in lines]


def _help(*arguments: str) -> str:
    result = CliRunner().invoke(app, [*arguments, "--help"])
    assert result.exit_code == 0, result.output
    return result.output


def _measured(eye: str, setting: str) -> dict:
    (row,) = [
        row
        for row in LIVE["rows"]
        if (row["method"], row["case"], row["setting"]) == ("frame", eye, setting)
    ]
    return row


@pytest.mark.parametrize("eye", preset_names())
def test_the_table_shows_what_was_measured(eye):
    small = _measured(eye, "480x270 2 cores")
    times = [
        f"{_measured(eye, setting)['median_ms']:.0f} ms"
        for setting in ("480x270 2 cores", "480x270 1 core")
    ]
    large = _measured(eye, "1280x720 2 cores")
    cells = [
        ROW_OF_EYE[eye],
        f"{small['error']:.1f} dB",
        *times,
        f"{large['error']:.1f} dB",
        f"{large['median_ms']:.0f} ms",
    ]
    assert f"| {' | '.join(cells)} |" in README


def test_the_smallest_client_is_as_small_as_it_says():
    lines = (ROOT / "clients/hello.py").read_text(encoding="utf-8").splitlines()
    assert len(lines) < 40
    assert f"service, {len(lines)} lines" in README


def test_every_make_target_of_the_readme_exists():
    named = set(re.findall(r"(?:^    |`)make ([a-z-]+)", README, re.MULTILINE))
    assert {"demo", "test"} <= named
    assert named <= _make_targets()


def test_every_public_make_target_is_phony_and_explained():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    phony = set(re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[1].split())
    assert _make_targets() == phony
    explained = set(re.findall(r"^([a-z-]+):.*  ## ", makefile, re.MULTILINE))
    wanted = {
        "demo",
        "web",
        "test",
        "test-training",
        "test-headset",
        "validate",
        "witness",
    }
    wanted |= {
        "check",
        "gpu-kit",
        "gl-witness",
        "test-batch-ray",
        "test-examples",
        "test-web",
    }
    assert wanted | {"clean", "help"} == explained


@pytest.mark.parametrize(
    "words", _indented_commands("ocufilter"), ids=lambda words: words[0]
)
def test_every_command_of_the_readme_is_one_that_help_knows(words):
    text = _help(words[0])
    options = [word for word in words if word.startswith("-")]
    unknown = [option for option in options if option not in re.split(r"[\s,]", text)]
    assert not unknown, text


def test_the_readme_shows_every_command_of_the_program():
    listed = re.findall(r"^  ([a-z]+)  ", _help().split("Commands:")[1], re.MULTILINE)
    assert {words[0] for words in _indented_commands("ocufilter")} == set(listed)


def test_every_profile_of_the_readme_is_accepted():
    bodies = re.findall(r'^    (\{"kind".*?\})$', README, re.MULTILINE | re.DOTALL)
    assert len(bodies) == 3
    for body in bodies:
        parse_profile(json.loads(body))


def test_the_readme_names_all_presets():
    sentence = re.search(r"Presets: ([^.]*)\.", README)[1]
    assert tuple(re.findall(r"`(\w+)`", sentence)) == preset_names()


def test_links_and_files_of_the_readme_exist():
    linked = re.findall(r"\]\(([^)#]+)\)", README)
    named = re.findall(r"`([\w/]+(?:\.md|/))`", README)
    local = [name for name in linked + named if "://" not in name]
    made_by_running = {"out/demo/"}
    # rooms are named by themselves
    homes = (ROOT, ROOT / "filter_service", ROOT / "estimator")
    missing = [
        name
        for name in local
        if name not in made_by_running and not any((h / name).exists() for h in homes)
    ]
    assert not missing
