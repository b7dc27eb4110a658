"""Metadata of pictures: which program, profile, pupil and focus made them."""

import hashlib
import json
import subprocess

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from clients.provenance import (
    METADATA_KEY,
    code_version,
    fingerprint,
    picture_metadata,
    profile_identity,
    profile_name,
)
from filter_service.image_files import read_color, write_image
from ocufilter import __version__
from tests.commands import run_command
from tests.source_tree import ROOT

BODY = {"kind": "prescription", "sphere_dpt": -2.0, "name": "Ada Lovelace"}
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.25}


def metadata_of(path):
    """Read the metadata of a picture with the library of its format."""
    if path.suffix == ".png":
        with Image.open(path) as image:
            return dict(image.text)
    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.parts[0].header
        return {"Software": header["software"], METADATA_KEY: header[METADATA_KEY]}


@pytest.mark.parametrize(
    ("name", "kind", "step"),
    [("a.png", "u1", 1), ("a.exr", "f4", 1 / 128), ("b.exr", "f2", 1 / 128)],
)
def test_metadata_survives_a_file_and_leaves_the_pixels_alone(
    tmp_path, name, kind, step
):
    made_by = {"version": "1.2.3", "commit": "abc123-dirty"}
    identity = profile_identity("jos\u00e9", BODY)
    image = (step * np.arange(4 * 6 * 3)).reshape(4, 6, 3).astype(kind)
    metadata = picture_metadata(made_by, identity, **STATE)
    write_image(tmp_path / name, image, metadata=metadata)
    found = metadata_of(tmp_path / name)
    assert found["Software"] == "ocufilter 1.2.3 (abc123-dirty)"
    expected = {**made_by, "profile": identity, **STATE}
    assert json.loads(found[METADATA_KEY]) == expected
    np.testing.assert_array_equal(read_color(tmp_path / name), image)


def test_the_hash_is_of_the_fields_in_any_order():
    text = '{"kind": "prescription", "name": "Ada Lovelace", "sphere_dpt": -2.0}'
    assert fingerprint(BODY) == hashlib.sha256(text.encode()).hexdigest()
    assert fingerprint(dict(reversed(BODY.items()))) == fingerprint(BODY)
    assert fingerprint({**BODY, "sphere_dpt": -2.25}) != fingerprint(BODY)


@pytest.mark.parametrize(
    ("text", "body", "name"),
    [
        ("myopia", {"kind": "preset", "name": "myopia"}, "myopia"),
        ("navarro", {"kind": "published", "name": "navarro"}, "navarro"),
        ("visits/p07.json", BODY, "p07"),
        (json.dumps(BODY), BODY, "Ada_Lovelace"),
        ('{"kind": "prescription"}', {"kind": "prescription"}, "profile"),
    ],
)
def test_the_name_of_a_file_stands_for_the_name_in_it(text, body, name):
    assert profile_name(text, body) == name


def test_the_version_is_that_of_the_package_and_the_commit_that_of_git():
    found = code_version()
    assert found["version"] == __version__
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    commit = str(found["commit"]).removesuffix("-dirty")
    answer = subprocess.run(
        ["git", "merge-base", "--is-ancestor", commit, "HEAD"], cwd=ROOT
    )
    assert answer.returncode == 0


@pytest.mark.parametrize("suffix", [".png", ".exr"])
@pytest.mark.long("an image is filtered")
def test_the_command_writes_what_its_json_says(tmp_path, suffix):
    color, out = tmp_path / "color.png", tmp_path / f"seen{suffix}"
    Image.fromarray(np.full((16, 24, 3), 128, np.uint8)).save(color)
    camera = ("--distance-m", 2, "--fov-deg", 2, "--mode", "on-axis")
    profile = ("--profile", "myopia", "--eye-model", "wavefront")
    finished = run_command(
        *("filter", "--color", color, *camera, *profile, "-o", out, "--json")
    )
    printed = json.loads(finished.stdout)
    found = json.loads(metadata_of(out)[METADATA_KEY])
    assert found["profile"]["name"] == "myopia"
    assert found["profile"]["sha256"] == printed["profile_sha256"]
    assert printed["made_by"] == code_version()
    for name in ("version", "commit"):
        assert found[name] == printed["made_by"][name]
    for name in ("pupil_diameter_mm", "focus_dpt"):
        assert found[name] == printed[name]
