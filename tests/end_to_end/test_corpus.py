"""What earlier versions wrote or understood is read as then (`tests/corpus`)."""

import base64
import json
import shutil
import subprocess
from dataclasses import asdict

import msgpack
import pytest

from clients.provenance import code_version, fingerprint
from estimator.profiles.files import load_profile
from filter_service import messages
from filter_service.protocol_schema import protocol_schema
from filter_service.service.config import load_config
from filter_service.settings import DEFAULTS
from tests.corpus.freeze import (
    FOLDER,
    commands,
    keep_eye,
    plain,
    printed_json,
    run_batch,
    shape_of,
)
from tests.end_to_end import test_javascript as javascript

pytestmark = pytest.mark.tools


def frozen(name):
    return json.loads((FOLDER / name).read_text(encoding="utf-8"))


def assert_holds(now, then, path=""):
    """Everything that there was is there, with the same values; notes may be added."""
    if isinstance(then, dict):
        for name, value in then.items():
            assert name in now, f"{path}.{name} is gone"
            assert_holds(now[name], value, f"{path}.{name}")
    elif isinstance(then, list) and path.endswith(".notes"):
        assert [note for note in then if note not in now] == [], path
    elif isinstance(then, list):
        assert len(now) == len(then), path
        for number, (item, old) in enumerate(zip(now, then, strict=True)):
            assert_holds(item, old, f"{path}[{number}]")
    elif isinstance(then, float):
        assert now == pytest.approx(then, rel=1e-12, abs=1e-15), path
    else:
        assert now == then, path


@pytest.mark.parametrize("entry", frozen("messages.json"), ids=lambda e: e["type"])
def test_messages_are_read_and_written_as_before(entry):
    is_request = entry["type"] in messages.REQUESTS
    decode = messages.decode_request if is_request else messages.decode_reply
    header = base64.b64decode(entry["header"])
    body = [b'{"kind": "preset"}'] if entry["type"] == "profile" else None
    parts = body or [bytes(size) for size in entry["part_sizes"]]
    message = decode([header, *parts])
    assert_holds(plain(message.fields()), without_ignored(entry["fields"]))
    written = msgpack.unpackb(messages.encode(message)[0])
    assert_holds(written, without_ignored(msgpack.unpackb(header)))


IGNORED = ("accuracy", "prepared_only")
"""Fields that the service reads past, see section 7 of the protocol."""


def without_ignored(fields):
    return {
        name: without_ignored(value) if isinstance(value, dict) else value
        for name, value in fields.items()
        if name not in IGNORED
    }


def test_the_schema_accepts_what_it_accepted():
    now, then = protocol_schema()["$defs"], frozen("schema.json")["$defs"]
    requests = {kind.__name__ for kind in messages.REQUESTS.values()}
    for name, old in then.items():
        new = now[name]
        assert set(old.get("properties", {})) <= set(new.get("properties", {})), name
        if name in requests:
            assert set(new.get("required", [])) <= set(old.get("required", [])), name
        for field, kind in old.get("properties", {}).items():
            for rule in ("type", "const", "minimum", "maximum", "maxLength", "$ref"):
                if rule in kind:
                    assert new["properties"][field].get(rule) == kind[rule], field


def test_a_configuration_file_means_the_same():
    found = plain(asdict(load_config(FOLDER / "service.toml")))
    assert_holds(found, frozen("service.json"))


@pytest.mark.parametrize("number", range(len(frozen("profiles.json"))))
def test_profiles_are_read_as_before(number, tmp_path):
    entry = frozen("profiles.json")[number]
    path = tmp_path / entry["name"]
    path.write_text(entry["text"], encoding="utf-8")
    assert_holds(plain(load_profile(str(path))), entry["read"])


@pytest.fixture
def begun(tmp_path):
    """A batch of another commit that lacks two of three frames."""
    shutil.copytree(FOLDER / "batch", tmp_path / "batch")
    return tmp_path / "batch"


def test_a_batch_of_another_version_is_refused(begun):
    with pytest.raises(subprocess.CalledProcessError) as caught:
        run_batch(begun / "frames", begun / "seen")
    assert caught.value.returncode == 2
    assert "made_by" in caught.value.stderr


def test_a_batch_that_was_begun_is_finished(begun):
    """As if this version had begun it: all else is read as it was written."""
    lines = (begun / "seen/manifest.jsonl").read_text().splitlines(keepends=True)
    job = json.loads(lines[0]) | {"made_by": code_version()}
    # Settings that were added since have their defaults.
    job["settings"] = DEFAULTS.fields() | job["settings"]
    del job["kind"], job["fingerprint"]
    first = {"kind": "job", "fingerprint": fingerprint(job), **job}
    lines[0] = json.dumps(first) + "\n"
    (begun / "seen/manifest.jsonl").write_text("".join(lines))
    before = {path: path.stat().st_mtime_ns for path in (begun / "seen").rglob("*.png")}
    assert len(before) == 1
    run_batch(begun / "frames", begun / "seen")
    assert len(list((begun / "seen").rglob("*.png"))) == 3
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_kept_eye_of_another_version_does_no_harm(tmp_path):
    """It is listed and kept, and not used: what is in it belongs to its code."""
    shutil.copytree(FOLDER / "eyes", tmp_path / "eyes")
    (name,) = (path.name for path in (tmp_path / "eyes").iterdir())
    listed = printed_json(["eyes", "list", "--dir", str(tmp_path / "eyes")])["eyes"]
    assert [eye["name"] for eye in listed] == [name.partition("-")[0]]
    assert "eye from the disk cache" not in keep_eye(tmp_path / "eyes")
    assert "eye from the disk cache" in keep_eye(tmp_path / "eyes")
    assert (tmp_path / "eyes" / name).exists()


def test_commands_print_the_json_that_they_did(tmp_path):
    then = frozen("json_output.json")
    for name, arguments in commands(tmp_path):
        now = shape_of(printed_json(arguments))
        packages = now.get("packages", {})
        for package, kind in packages.items():
            if kind == "NoneType":  # not installed here
                packages[package] = "str"
        if "notes" in now:  # texts for people, any number of them
            assert set(now["notes"]) <= {"str"}
            now["notes"] = then[name]["notes"]
        assert_holds(now, then[name], name)


@javascript.needs_node
def test_the_javascript_client_of_before_works(shared_service, tmp_path, monkeypatch):
    for name in ("filter_client.js", "check.js"):
        shutil.copy(FOLDER / "js" / name, tmp_path / name)
    for name in ("node_modules", "package.json"):
        (tmp_path / name).symlink_to(javascript.FOLDER / name)
    monkeypatch.setattr(javascript, "FOLDER", tmp_path)
    profiles = [json.dumps({"kind": "double", "mark": mark}) for mark in (5, 7, 8)]
    found = javascript.checked(shared_service, *profiles)
    assert found["stereo"] == [235, 225]
    assert found["eyesAgain"] == [7, 8]
