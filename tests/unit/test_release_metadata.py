"""Checks of a release: metadata, NOTICE and the bill of materials."""

import io
import json
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import distribution

import pytest

from tests.release import metadata, notices, sbom
from tests.release.requirements import USER_EXTRAS, declared, installed, project
from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

CHANGELOG = (
    "# Changelog\n\n## Unreleased\n\n## 1.2.0 - 2026-01-02\n\n## 1.1.0 - 2025-01-02\n"
)
CITATION = 'title: t\nversion: 1.2.0\ndate-released: "2026-01-02"\n'


def test_the_version_is_the_same_everywhere():
    texts = [(ROOT / n).read_text("utf-8") for n in ("CHANGELOG.md", "CITATION.cff")]
    assert metadata.version_problems(project()["version"], *texts) == []


@pytest.mark.parametrize(
    ("version", "changelog", "citation", "problem"),
    [
        ("1.3.0", CHANGELOG, CITATION, "newest version is 1.2.0, not 1.3.0"),
        ("1.2.0", CHANGELOG.replace("Unreleased", "Next"), CITATION, "'Unreleased'"),
        ("1.2.0", CHANGELOG.replace(" - 2025-01-02", ""), CITATION, "no date"),
        ("1.2.0", CHANGELOG, CITATION.replace("1.2.0", "1.1.0"), "version is not"),
        ("1.2.0", CHANGELOG, CITATION.replace("01-02", "01-03"), "date-released"),
    ],
)
def test_another_version_is_a_problem(version, changelog, citation, problem):
    assert metadata.version_problems("1.2.0", CHANGELOG, CITATION) == []
    found = metadata.version_problems(version, changelog, citation)
    assert problem in found[0]


def test_no_license_is_reported_and_half_of_one_is_a_problem(tmp_path):
    table = {"classifiers": []}
    problems, choices = metadata.license_problems(table, tmp_path)
    assert problems == []
    assert choices[0].startswith("no license chosen")
    licensed = {**table, "license": "MIT"}
    assert "no LICENSE" in metadata.license_problems(licensed, tmp_path)[0][0]
    (tmp_path / "LICENSE").touch()
    assert "no license =" in metadata.license_problems(table, tmp_path)[0][0]
    assert metadata.license_problems(licensed, tmp_path) == ([], [])
    classified = {**licensed, "classifiers": ["License :: OSI Approved :: MIT License"]}
    assert metadata.license_problems(classified, tmp_path)[0]


def test_one_file_and_one_line_complete_the_license(tmp_path):
    """The built metadata then name the license and contain both files."""
    table = (ROOT / "pyproject.toml").read_text("utf-8")
    (tmp_path / "pyproject.toml").write_text(
        table.replace('# license = "..."', 'license = "MIT"'), "utf-8"
    )
    for name in ("README.md", "NOTICE"):
        (tmp_path / name).write_text("text\n", "utf-8")
    (tmp_path / "LICENSE").write_text("terms\n", "utf-8")
    build = "from setuptools.build_meta import prepare_metadata_for_build_wheel as p\n"
    subprocess.run(
        [sys.executable, "-c", f"{build}p('.')"],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    (text,) = (p.read_text("utf-8") for p in tmp_path.glob("*.dist-info/METADATA"))
    assert "License-Expression: MIT\n" in text
    assert "License-File: LICENSE\n" in text
    assert "License-File: NOTICE\n" in text


def _wheel(path, version="1.2.0", files=("NOTICE",)):
    head = f"Metadata-Version: 2.4\nName: ocufilter\nVersion: {version}\n"
    head += "".join(f"License-File: {file}\n" for file in files)
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("ocufilter.dist-info/METADATA", head)
        for file in files:
            wheel.writestr(f"ocufilter.dist-info/licenses/{file}", "text")
    return path, head


def test_the_metadata_of_distributions_are_compared(tmp_path):
    table = {"name": "ocufilter", "version": "1.2.0"}
    good, head = _wheel(tmp_path / "a.whl")
    assert metadata.distribution_problems(good, table) == []
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as sdist:
        for name, text in (("PKG-INFO", head), ("NOTICE", "text")):
            member = tarfile.TarInfo(f"ocufilter-1.2.0/{name}")
            member.size = len(text)
            sdist.addfile(member, io.BytesIO(text.encode()))
    assert metadata.distribution_problems(tmp_path / "a.tar.gz", table) == []
    old, _ = _wheel(tmp_path / "b.whl", version="1.1.0")
    assert "Version is 1.1.0" in metadata.distribution_problems(old, table)[0]
    bare, _ = _wheel(tmp_path / "c.whl", files=())
    assert len(metadata.distribution_problems(bare, table)) == 2
    licensed = {**table, "license": "MIT"}
    assert len(metadata.distribution_problems(good, licensed)) == 3


def test_the_citation_is_valid():
    pytest.importorskip("check_jsonschema", reason="sh setup.sh release installs it")
    assert metadata.citation_problems(ROOT / "CITATION.cff") == []


def test_the_classifiers_are_known():
    pytest.importorskip("trove_classifiers", reason="sh setup.sh release installs it")
    assert metadata.classifier_problems(project()) == []


def test_every_package_and_file_has_an_entry(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["notices"])
    assert notices.main() == 0, capsys.readouterr().err


def test_a_new_dependency_without_an_entry_is_a_problem():
    packages = installed(declared())
    entries = [notices.entry_of(p) for p in packages.values()]
    assert notices.package_problems(entries, packages) == []
    more = {**packages, "pytest": distribution("pytest"), "missing": None}
    problems = notices.package_problems(entries, more)
    assert problems == ["package pytest: no entry", "package missing: no entry"]
    fewer = {name: p for name, p in packages.items() if name != "lz4"}
    assert notices.package_problems(entries, fewer) == ["package lz4: not required"]
    changed = [e.replace("lz4 | BSD-3-Clause", "lz4 | MIT") for e in entries]
    (problem,) = notices.package_problems(changed, packages)
    assert problem.startswith("package lz4: is 'lz4 | MIT")


def test_a_requirement_of_an_extra_is_followed():
    assert {"moderngl", "glcontext"} <= installed(["moderngl"]).keys()
    assert "pydantic" not in installed(["fsspec"])
    assert set(declared()) < set(declared(USER_EXTRAS))


def test_a_new_data_file_without_an_entry_is_a_problem():
    entries = ["a/b.json | somewhere | MIT", "images/ | own work | as ocufilter"]
    files = ["a/b.json", "images/c.png", "a/code.py", "a/x.schema.json"]
    assert notices.data_problems(entries, files) == []
    assert notices.data_problems(entries, [*files, "a/d.npz"]) == [
        "file a/d.npz: no entry"
    ]
    assert notices.data_problems(entries, files[:1]) == ["file images/: does not exist"]


def test_a_node_package_without_an_entry_is_a_problem():
    manifest = json.dumps({"dependencies": {"a": "1"}, "devDependencies": {"b": "1"}})
    assert notices.node_problems(["a | MIT | x", "b | MIT | x"], [manifest]) == []
    problems = notices.node_problems(["a | MIT | x", "c | MIT | x"], [manifest])
    assert problems == ["Node package b: no entry", "Node package c: not required"]


def test_the_bill_of_materials_contains_what_users_install_only():
    names = ("Tool.X", "my.lib", "core")
    bom = {
        "metadata": {"component": {"bom-ref": "root"}},
        "components": [{"bom-ref": f"{name}==1", "name": name} for name in names],
        "dependencies": [
            {"ref": "root", "dependsOn": ["my.lib==1", "Tool.X==1"]},
            {"ref": "my.lib==1", "dependsOn": ["core==1", "Tool.X==1"]},
            {"ref": "Tool.X==1", "dependsOn": ["core==1"]},
            {"ref": "core==1"},
        ],
    }
    found = sbom.restricted(bom, {"my-lib": "MIT", "core": "ISC", "other": "ISC"})
    assert [(c["name"], c["licenses"]) for c in found["components"]] == [
        ("my.lib", [{"expression": "MIT"}]),
        ("core", [{"expression": "ISC"}]),
    ]
    assert found["dependencies"] == [
        {"ref": "root", "dependsOn": ["my.lib==1"]},
        {"ref": "my.lib==1", "dependsOn": ["core==1"]},
        {"ref": "core==1", "dependsOn": []},
    ]


def test_an_invalid_bill_of_materials_is_refused():
    pytest.importorskip("cyclonedx", reason="sh setup.sh release installs it")
    bom = {"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1}
    text = json.dumps({**bom, "components": [{"type": "library", "name": "a"}]})
    assert sbom.validated(text) == text
    with pytest.raises(ValueError, match=r"not valid CycloneDX 1\.6"):
        sbom.validated(json.dumps({**bom, "components": [{"name": "a"}]}))
