"""Documents name files, links, targets and profiles that exist."""

import json
import re

import pytest

from estimator.profiles.parse import parse_profile, preset_names
from tests.source_tree import ROOT

DOCUMENTS = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in ("", "docs", "filter_service", "shaders", "training", "examples")
    for path in (
        (ROOT / folder).rglob("*.md")
        if folder == "docs"
        else (ROOT / folder).glob("*.md")
    )
)
GENERATED = {
    f"docs/reference/{name}.md" for name in ("api", "command-line", "settings")
}
"""Pages that only the built documentation has."""


def text_of(document: str) -> str:
    return (ROOT / document).read_text(encoding="utf-8")


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z][a-z-]*):", text_of("Makefile"), re.MULTILINE))


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_to_files(document):
    folder = (ROOT / document).parent
    for link in re.findall(r"\]\(([^)\s]+)\)", text_of(document)):
        target = link.partition("#")[0]
        if not target or "://" in link:
            continue
        path = (folder / target).resolve()
        if path.relative_to(ROOT).as_posix() not in GENERATED:
            assert path.exists(), link


@pytest.mark.parametrize(
    "document", [name for name in DOCUMENTS if "CHANGE" not in name]
)
def test_files_that_are_named_exist(document):
    named = re.findall(
        r"`((?:clients|docs|estimator|examples|filter_service|ocufilter|shaders|tests|training)"
        r"/[\w/.]+)`",
        text_of(document),
    )
    homes = (ROOT, (ROOT / document).parent)
    assert not [n for n in named if not any((home / n).exists() for home in homes)]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_make_targets_exist(document):
    named = set(
        re.findall(r"(?:^    |`)make ([a-z-]+)", text_of(document), re.MULTILINE)
    )
    assert named <= make_targets()


def test_every_public_make_target_is_phony_and_explained():
    makefile = text_of("Makefile")
    phony = set(re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)[1].split())
    assert make_targets() == phony
    explained = set(re.findall(r"^([a-z-]+):.*  ## ", makefile, re.MULTILINE))
    assert {name for name in phony if not name.startswith("setup-")} == explained


def test_the_readme_is_short():
    # Marks and sources of generated tables are not read.
    text = re.sub(r"<!--.*?-->|^Measured: .*$", "", text_of("README.md"), flags=re.M)
    assert len(text.split()) <= 800


@pytest.mark.parametrize("document", DOCUMENTS)
def test_profiles_that_are_shown_are_accepted(document):
    blocks = re.findall(r'^    (\{"kind".*?\})$', text_of(document), re.M | re.DOTALL)
    for body in blocks:
        if "..." not in body:
            parse_profile(json.loads(body))


def test_the_presets_are_those_that_exist():
    page = text_of("docs/reference/profiles.md")
    sentence = re.search(r"The name of a preset is also a profile: ([^.]*)\.", page)[1]
    assert tuple(re.findall(r"`(\w+)`", sentence)) == preset_names()
