"""Changed files and random profiles: one error type, bounded work and memory.

`tests/file_mutants.py` lists the readers of files from outside.  Every
changed file has a number, which repeats it: `mutant(kind, number)`.
"""

import json
import random
import time
import tracemalloc
from contextlib import suppress

import pytest

from clients.batch.eye_table import read_eyes
from estimator import InvalidFile
from estimator.bounded_files import printable
from estimator.eye.checked_fields import ProfileError
from estimator.profiles.given_bodies import KINDS
from estimator.profiles.given_eyes import biconvex_radius_mm
from estimator.profiles.parse import parse_profile
from tests.benchmarks.bench_files import (
    MAX_MEMORY_MB,
    MAX_READ_S,
    REFUSED,
    VALID,
    Reads,
    outcome_of,
)
from tests.file_mutants import kinds, mutant
from tests.schema_profiles import EXTREMES, disturbed, drawn_profile

N_FILES, N_PROFILES = 2_000, 20_000
"""Of each kind, among the slow tests."""

N_BRIEF = 10
MAX_TRACED_MB = 100.0
"""Memory that Python allocates in one read of a brief test."""

SCHEMA = "profile of the schema"
FILES = (
    *("color", "depth", "npy", "OpenEXR", "photo", "profile", "display", "TUM list"),
    *(
        "calibration",
        "states",
        "eyes",
        "manifest",
        "video",
        "glTF",
        "stored eye",
        "lens file",
    ),
    *("given eye", "configuration", "key", "link", "training set", "people"),
)


@pytest.fixture(scope="module")
def kind_named(tmp_path_factory):
    """Return the kinds by name; each has read its files, which loads code."""
    pytest.importorskip("clients.batch.video_reading")
    found = {kind.name: kind for kind in kinds(tmp_path_factory.mktemp("kinds"))}
    assert set(found) == {*FILES, SCHEMA}
    folder = tmp_path_factory.mktemp("valid")
    for kind in found.values():
        for name, content in kind.files.items():
            if kind.make is None:
                (folder / name).write_bytes(content)
                with suppress(*kind.errors):  # not all are valid as they are
                    kind.read(folder / name)
                (folder / name).unlink()
    for number in range(20):  # loads the code that traces
        with suppress(ProfileError):
            parse_profile(drawn_profile(random.Random(number)))
    return found


def read_in_bounds(kind, number, folder):
    """Read one changed file; return what came of it."""
    name, content = mutant(kind, number)
    path = folder / name
    path.write_bytes(content)
    start_s = time.process_time()
    try:
        kind.read(path)
        found = VALID
    except Exception as error:
        found = outcome_of(kind, error)
    assert time.process_time() - start_s < MAX_READ_S, f"number {number}"
    path.unlink(missing_ok=True)
    assert found in (VALID, REFUSED), f"number {number}: {found}"
    return found


@pytest.mark.parametrize("name", FILES)
def test_a_changed_file_is_read_or_refused(kind_named, tmp_path, name):
    for number in range(N_BRIEF):
        read_in_bounds(kind_named[name], number, tmp_path)


@pytest.mark.parametrize("first", range(0, 30 * N_BRIEF, N_BRIEF))
def test_a_profile_of_the_schema_is_read_or_refused(kind_named, tmp_path, first):
    numbers = range(first, first + N_BRIEF)
    for number in numbers:
        read_in_bounds(kind_named[SCHEMA], number, tmp_path)


@pytest.mark.long("traces the memory of every reader")
def test_a_changed_file_takes_little_memory(kind_named, tmp_path):
    for name, kind in kind_named.items():
        tracemalloc.start()
        try:
            read_in_bounds(kind, 0, tmp_path)
            peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
        finally:
            tracemalloc.stop()
        assert peak_mb < MAX_TRACED_MB, name


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FILES, SCHEMA])
def test_thousands_of_changed_files_are_read_or_refused(kind_named, name):
    """In a process whose address space is limited."""
    reads = Reads(kind_named[name])
    reads.run(N_PROFILES if name == SCHEMA else N_FILES)
    assert not reads.wrong
    assert reads.peak_mb < MAX_MEMORY_MB
    assert reads.raised.keys() <= {VALID, REFUSED}


# ----- what such files found


@pytest.mark.parametrize("power_dpt", [5e-324, -5e-324, 1e-300, 1e-17, 1e-9])
def test_an_implant_of_almost_no_power_is_flat(power_dpt):
    found_mm = biconvex_radius_mm(power_dpt, index=1.47, thickness_mm=0.8)
    assert found_mm == pytest.approx(2.0 * 1000.0 * (1.47 - 1.336) / power_dpt)
    body = {
        "kind": "pseudophakic",
        "axial_length_mm": 23.5,
        "keratometry_dpt": [43.0, 43.0],
        "lens_center_mm": 5.0,
        "implant": {"power_dpt": power_dpt},
    }
    assert parse_profile(body).kind == "pseudophakic"


@pytest.mark.parametrize("value", [{}, [], "x", True, [1, 2]])
def test_a_wrong_radius_in_a_list_is_named(value):
    surface = {"radius_mm": [12, value], "z_mm": 0, "medium_after": "cornea"}
    body = {
        "kind": "surfaces",
        "surfaces": [surface],
        "stop_z_mm": 3,
        "retina": {"radius_mm": -12, "z_mm": 24},
    }
    with pytest.raises(ProfileError, match="is not a number") as at:
        parse_profile(body)
    assert at.value.field == "surfaces.0.radius_mm.1"


def test_a_profile_of_a_table_whose_name_is_too_long_is_refused(tmp_path):
    file = tmp_path / "eyes.csv"
    file.write_text(f"image,profile\n*,{'(' * 5000}\n")
    with pytest.raises(InvalidFile, match="line 2: profile"):
        read_eyes(file, named={})


def test_a_field_s_name_cannot_forge_lines():
    with pytest.raises(ProfileError) as caught:
        parse_profile({"kind": "preset", "name": "myopia", "a\nb\x1b" + "x" * 9999: 1})
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2000
    assert caught.value.field.startswith("a\\nb\\x1bxxx")


def test_a_profile_s_name_is_one_line():
    body = {"kind": "preset", "name": "myopia"}
    named = {
        **body,
        "kind": "prescription",
        "sphere_dpt": 0,
        "name": "a\nb" + "x" * 999,
    }
    found = parse_profile(named).name
    assert found.startswith("a\\nbxxx")
    assert len(found) <= 201


def test_printable_text():
    assert printable("é \u2032 plain") == "é \u2032 plain"
    assert printable("a\n\x1b\u202e\ud800\U000e0001") == (
        "a\\n\\x1b\\u202e\\ud800\\U000e0001"
    )
    assert printable("x" * 99, most=10) == "xxxxxxx..."


def test_the_generator_repeats_itself_and_reaches_every_kind():
    drawn = [drawn_profile(random.Random(number)) for number in range(100)]
    again = [drawn_profile(random.Random(number)) for number in range(100)]
    assert json.dumps(drawn) == json.dumps(again)
    assert {body["kind"] for body in drawn} == set(KINDS)
    strange = json.dumps([disturbed(one, random.Random(1), 3) for one in drawn])
    assert all(json.dumps(value) in strange for value in EXTREMES[:3])
