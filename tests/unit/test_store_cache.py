"""Stores on disk: they come back as they were, or not at all, whatever happens."""

import json
import logging
import multiprocessing
import os
import pickle
import resource
import signal
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.commands.program import app
from estimator.note import Note
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.errors import BuildCancelled
from filter_service.messages import Camera
from filter_service.planning.plan import plan_cache
from filter_service.psfs import store_cache, store_file
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.pack import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.psfs.store_cache import (
    StoreCache,
    Stored,
    cached_eyes,
    erase_eyes,
    eye_name,
    store_key,
)
from tests.grid_specs import grid_spec

PROFILE = parse_profile({"kind": "prescription", "sphere_dpt": -1.0})
CAMERA = Camera(96, 54, (-0.5, 0.5, 0.28, -0.28))
SPEC = grid_spec(
    CAMERA,
    pupil_range_mm=(4.0, 4.0),
    focus_range_dpt=(0.0, 0.0),
    object_range_dpt=(0.0, 1.0),
)


def nothing():
    """Stand for a build that is not cancelled."""


def key_of(number):
    return f"{number:032x}"


def entry_path(tmp_path, number):
    """File of a key, in the folder of `cache`."""
    return tmp_path / "stores" / f"{key_of(number)}.psfs"


def write_entry(path, header, arrays=b""):
    """Write a file with any header and arrays, and right sizes and checksums."""
    start = store_file.PREAMBLE.size + len(header)
    sums = zlib.crc32(header), zlib.crc32(arrays)
    preamble = (store_file.MAGIC, len(header), start, len(arrays), *sums)
    path.write_bytes(store_file.PREAMBLE.pack(*preamble) + header + arrays)


def read_entry(path):
    """Return header and arrays of a file."""
    data = path.read_bytes()
    _, n_header, start, *_ = store_file.PREAMBLE.unpack_from(data)
    return data[store_file.PREAMBLE.size :][:n_header], data[start:]


def is_same(first, second):
    """Compare two packed objects, arrays by value."""
    (tree, arrays), (other_tree, other_arrays) = map(store_file.pack, (first, second))
    return (
        json.dumps(tree) == json.dumps(other_tree)  # where nan is nan
        and arrays.keys() == other_arrays.keys()
        and all(
            array.dtype == other_arrays[name].dtype
            and np.array_equal(array, other_arrays[name], equal_nan=True)
            for name, array in arrays.items()
        )
    )


@pytest.fixture(scope="module")
def stored():
    eye = MeasuredWavefront.from_profile(PROFILE)
    return Stored(PsfStore(eye, SPEC, plan_cache(eye, SPEC)).parts, ("a note",))


@pytest.fixture
def cache(tmp_path):
    return StoreCache(str(tmp_path / "stores"), max_mb=100)


@pytest.fixture
def path(cache, stored, tmp_path):
    cache.save(key_of(1), stored)
    return entry_path(tmp_path, 1)


def test_a_store_comes_back_whole_and_its_eye_answers_the_same(cache, stored, path):
    again = cache.load(key_of(1), check_cancelled=nothing)
    assert is_same(again, stored)
    assert again.parts["spec"] == stored.parts["spec"]
    assert again.notes == ("a note",)
    state = {"pupil_diameter_mm": 4.0, "accommodation_dpt": 0.0, "wavelength_nm": 550.0}
    assert again.parts["eye"].total_defocus_dpt(**state) == pytest.approx(
        stored.parts["eye"].total_defocus_dpt(**state), abs=0
    )
    assert cache.load(key_of(2), check_cancelled=nothing) is None


@pytest.mark.long("a drawn eye is estimated and traced over the field")
def test_a_drawn_eye_comes_back_with_its_periphery(cache):
    spec = SPEC.with_settings(mode="dynamic")
    eye, notes = eye_for_spec(replace(PROFILE, sample=3), spec)
    cache.save(key_of(1), Stored({"eye": eye}, notes))
    again = cache.load(key_of(1), check_cancelled=nothing).parts["eye"]
    state = {"pupil_diameter_mm": 4.0, "accommodation_dpt": 0.0, "wavelength_nm": 536.0}
    h_deg = np.linspace(-20.0, 20.0, 5)
    assert eye.periphery.change.off_meridian_draw is not None
    np.testing.assert_array_equal(
        again.total_defocus_dpt(h_deg=h_deg, v_deg=5.0, **state),
        eye.total_defocus_dpt(h_deg=h_deg, v_deg=5.0, **state),
    )


def test_a_named_tuple_is_not_stored_as_a_plain_one():
    named = store_file.pack({"tables": StoreTables.empty()._asdict()})
    assert len(named[1]) == len(StoreTables._fields)
    with pytest.raises(store_file.NotStorable, match="tables is a StoreTables"):
        store_file.pack({"tables": StoreTables.empty()})


def test_the_folder_is_for_its_owner_only_and_holds_no_pickle(path):
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert path.stat().st_mode & 0o077 == 0
    assert path.read_bytes().startswith(store_file.MAGIC)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("kept_ratio", [0.0, 0.0001, 0.5, 0.999])
def test_a_truncated_file_is_removed_with_a_word(cache, path, caplog, kept_ratio):
    with path.open("r+b") as file:
        file.truncate(int(kept_ratio * path.stat().st_size))
    with caplog.at_level(logging.WARNING):
        assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert not path.exists()
    assert f"removed a damaged file from {path.parent}" in caplog.text
    assert key_of(1) not in caplog.text


@pytest.mark.parametrize("at_ratio", [0.0, 0.0003, 0.3, 0.9])
def test_a_changed_file_is_removed(cache, path, at_ratio):
    with path.open("r+b") as file:
        file.seek(int(at_ratio * path.stat().st_size))
        was = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([was[0] ^ 0x40]))
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert not path.exists()


def test_a_file_cannot_name_other_code_than_ours(cache, path):
    header, arrays = read_entry(path)
    write_entry(path, header, arrays)
    assert cache.load(key_of(1), check_cancelled=nothing) is not None
    content = json.loads(header)
    content["tree"]["object"][0] = "subprocess:Popen"
    write_entry(path, json.dumps(content).encode(), arrays)
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert not path.exists()


def _write_until_killed(folder):
    """Write a file that exceeds the limit at which the system ends the process."""
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))
    parts = {"kernels": np.zeros(2**22, np.uint8)}
    StoreCache(folder, max_mb=100).save(key_of(3), Stored(parts, ()))


@pytest.mark.long("a process starts")
def test_a_crash_while_writing_leaves_nothing_that_is_read(cache, tmp_path, stored):
    folder = tmp_path / "stores"
    context = multiprocessing.get_context("spawn")
    writer = context.Process(target=_write_until_killed, args=(str(folder),))
    writer.start()
    writer.join(30.0)
    assert writer.exitcode == -signal.SIGXFSZ
    (left,) = folder.iterdir()
    assert left.stat().st_size == 2**20
    assert left.suffix == store_file.UNFINISHED
    assert cache.load(key_of(3), check_cancelled=nothing) is None
    os.utime(left, (time.time() - 2 * store_cache.ABANDONED_S,) * 2)
    cache.save(key_of(4), stored)
    assert [p.name for p in folder.iterdir()] == [f"{key_of(4)}.psfs"]


def test_a_cancelled_load_stops_and_leaves_the_file(cache, path):
    def cancel():
        raise BuildCancelled("replaced by a newer profile")

    with pytest.raises(BuildCancelled):
        cache.load(key_of(1), check_cancelled=cancel)
    assert path.exists()


def test_a_full_folder_loses_what_was_used_longest_ago(tmp_path, stored):
    size_mb = 1e-6 * store_file.write_file(tmp_path / "one.psfs", stored)
    cache = StoreCache(str(tmp_path / "stores"), max_mb=3.5 * size_mb)
    for number in range(3):
        cache.save(key_of(number), stored)
        os.utime(entry_path(tmp_path, number), (1000 + number,) * 2)
    cache.load(key_of(0), check_cancelled=nothing)
    cache.save(key_of(3), stored)
    there = {p.stem for p in (tmp_path / "stores").iterdir()}
    assert there == {key_of(0), key_of(2), key_of(3)}
    small = StoreCache(str(tmp_path / "small"), max_mb=1e-6)
    small.save(key_of(0), stored)
    assert list((tmp_path / "small").iterdir()) == []


def test_without_a_folder_nothing_is_kept(stored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cache = StoreCache("", max_mb=100)
    cache.save(key_of(1), stored)
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_costs_a_log_line(tmp_path, stored, caplog):
    taken = tmp_path / "taken"
    taken.write_text("a file")
    StoreCache(str(taken), max_mb=100).save(key_of(1), stored)
    assert "cannot be written" in caplog.text


def _save_and_load(folder, seed, failures):
    """Save and load a few keys at random, in a folder that is always too small."""
    rng = np.random.default_rng(seed)
    values = {n: np.full(50_000, n, np.uint16) for n in range(6)}
    cache = StoreCache(folder, max_mb=0.35)
    for _ in range(60):
        n = int(rng.integers(6))
        found = cache.load(key_of(n), check_cancelled=nothing)
        if found is None:
            cache.save(key_of(n), Stored({"n": n, "kernels": values[n]}, ()))
        elif found.parts["n"] != n or not (found.parts["kernels"] == n).all():
            failures.put(f"{n}: {found}")


@pytest.mark.long("two processes start")
def test_two_processes_share_a_folder(tmp_path, caplog):
    context = multiprocessing.get_context("spawn")
    failures = context.SimpleQueue()
    folder = str(tmp_path / "stores")
    processes = [
        context.Process(target=_save_and_load, args=(folder, seed, failures))
        for seed in range(2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(30.0)
    assert [process.exitcode for process in processes] == [0, 0]
    assert failures.empty()
    assert all(p.suffix == ".psfs" for p in (tmp_path / "stores").iterdir())


def test_the_key_tells_apart_what_changes_a_store():
    def key(profile=PROFILE, spec=SPEC, **settings):
        return store_key(profile, spec.with_settings(**settings))

    same_again = parse_profile({"sphere_dpt": -1, "kind": "prescription"})
    assert key(profile=same_again) == key()
    shifted = replace(SPEC, camera=Camera(96, 54, (-0.4, 0.6, 0.28, -0.28)))
    assert key(spec=shifted) == key(), "on axis a store knows the pixel size only"
    field = SPEC.with_settings(mode="dynamic")
    others = [
        key(profile=parse_profile({"kind": "prescription", "sphere_dpt": -1.25})),
        key(eye_model="wavefront"),
        key(tolerance="fine"),
        key(pupil_range_mm=(4.0, 4.5)),
        key(spec=field),
        key(spec=replace(field, camera=shifted.camera)),
        key(spec=field, gaze_deg=(1.0, 0.0)),
        key(spec=field, gaze_range_deg=(1.0, 0.0)),
        key(spec=field, lateral_color=True),
        key(stiles_crawford=True),
        key(stiles_crawford=True, profile=replace(PROFILE, eye_side="OS")),
        key(age_years=50.0),
    ]
    assert len({key(), *others}) == 1 + len(others)


@pytest.fixture
def own_version():
    store_cache.code_version.cache_clear()
    yield
    store_cache.code_version.cache_clear()


@pytest.mark.usefixtures("own_version")
def test_the_key_follows_every_file_of_the_code(tmp_path, monkeypatch):
    def key():
        store_cache.code_version.cache_clear()
        return store_key(PROFILE, SPEC)

    keys = set()
    for package in ("estimator", "filter_service"):
        (tmp_path / package).mkdir()
        source = tmp_path / package / "__init__.py"
        source.write_text("")
        module = getattr(store_cache, package)
        monkeypatch.setattr(module, "__file__", str(source))
    monkeypatch.setattr(store_cache, "SHADER_ROOT", tmp_path / "shaders")
    monkeypatch.setenv("OCUFILTER_LIBRARY_DIR", str(tmp_path / "libraries"))
    shader = tmp_path / "shaders" / "passes" / "psf_sum.comp.glsl"
    shader.parent.mkdir(parents=True)
    for path in (
        tmp_path / "estimator" / "presets.json",
        tmp_path / "filter_service" / "psfs" / "build.py",
        shader,
        tmp_path / "libraries" / "_core.so",
        tmp_path / "libraries" / "_loops.so",
    ):
        keys.add(key())
        path.parent.mkdir(exist_ok=True)
        path.write_text("changed")
        keys.add(key())
    assert len(keys) == 6


def test_what_is_no_data_is_not_stored(cache, stored, caplog, tmp_path):
    strange = Stored(stored.parts | {"by": print}, ())
    cache.save(key_of(1), strange)
    assert "parts.by" in caplog.text
    assert list((tmp_path / "stores").iterdir()) == []


@pytest.fixture
def kept(tmp_path, stored):
    """Two stores of one eye and one of another, in a folder of their own."""
    folder = tmp_path / "kept"
    cache = StoreCache(str(folder), max_mb=1000)
    other = parse_profile({"kind": "prescription", "sphere_dpt": -1.25})
    for profile, spec in (
        (PROFILE, SPEC),
        (PROFILE, SPEC.with_settings(tolerance="fine")),
        (other, SPEC),
    ):
        cache.save(store_key(profile, spec), stored)
    return folder


def eyes_command(*arguments):
    return CliRunner().invoke(app, ["eyes", *map(str, arguments)])


def test_kept_eyes_are_listed_without_saying_whose_they_are(kept):
    said = json.loads(eyes_command("list", "--dir", kept, "--json").stdout)["eyes"]
    assert sorted(eye["n_files"] for eye in said) == [1, 2]
    assert eye_name(PROFILE) in [eye["name"] for eye in said]
    assert sum(eye["size_bytes"] for eye in said) == sum(
        path.stat().st_size for path in kept.iterdir()
    )
    assert not any(b"sphere" in path.read_bytes()[:4096] for path in kept.iterdir())
    shown = eyes_command("list", "--dir", kept).stdout
    assert eye_name(PROFILE)[:12] in shown
    assert "2 files" in shown


def test_a_person_s_eye_is_erased_and_no_other(kept, tmp_path):
    profile = tmp_path / "anna.json"
    profile.write_text(json.dumps({"kind": "prescription", "sphere_dpt": -1.0}))
    assert "2 files" in eyes_command("erase", profile, "--dir", kept).output
    (left,) = kept.iterdir()
    assert not left.name.startswith(eye_name(PROFILE))
    assert "nothing" in eyes_command("erase", profile, "--dir", kept).output
    assert (
        "1 file" in eyes_command("erase", "--name", left.name[:9], "--dir", kept).output
    )
    assert "no eyes are cached" in eyes_command("list", "--dir", kept).output


def test_all_eyes_are_erased_at_once(kept):
    (kept / "note.txt").write_text("not ours")
    eyes_command("erase", "--all", "--dir", kept)
    assert [path.name for path in kept.iterdir()] == ["note.txt"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["erase"], "one of"),
        (["erase", "myopia", "--all"], "one of"),
        (["erase", "--name", "*"], "allowed"),
        (["erase", "--name", ""], "allowed"),
        (["list", "--dir", "/no/such/folder"], "is not a folder"),
        (["list"], "no cache folder"),
    ],
)
def test_what_cannot_be_erased_or_listed_is_said(arguments, text, monkeypatch):
    monkeypatch.setenv("OCUFILTER_CACHE_DIR", "")
    result = eyes_command(*arguments)
    assert isinstance(result.exception, ValueError | FileNotFoundError)
    assert text in str(result.exception)


def test_nothing_is_kept_where_others_may_look(tmp_path, stored, caplog):
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o755)
    StoreCache(str(folder), max_mb=1000).save(key_of(1), stored)
    assert not list(folder.iterdir())
    assert f"chmod 700 {folder}" in caplog.text


def test_a_folder_under_an_entrys_name_is_passed_over_and_logged_once(
    cache, path, stored, caplog
):
    path.unlink()
    path.mkdir()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert cache.load(key_of(1), check_cancelled=nothing) is None
            cache.save(key_of(1), stored)
    begin = f"a file in {path.parent} "
    told = [r for r in caplog.records if r.getMessage().startswith(begin)]
    assert len(told) == 2, caplog.text  # one of reading, one of writing
    assert key_of(1) not in caplog.text
    assert path.is_dir()
    assert cached_eyes(path.parent) == []
    assert erase_eyes(path.parent) == 0


def test_a_link_is_not_followed(cache, path, tmp_path):
    moved = tmp_path / "moved"
    path.rename(moved)
    path.symlink_to(moved)
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert moved.is_file()


@pytest.mark.parametrize(
    "tree",
    [
        None,
        5,
        [],
        {"array": "none"},
        {"object": []},
        {"object": ["estimator.nothing:A", {}]},
        {"object": ["filter_service.psfs.store_cache:Stored", {"store": {"tuple": 5}}]},
        {"object": ["filter_service.camera:Camera", {}]},
    ],
)
def test_an_entry_with_another_content_is_removed(cache, path, tree):
    write_entry(path, json.dumps({"arrays": {}, "tree": tree}).encode())
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert not path.exists()


def test_an_entry_nested_too_deep_is_removed(cache, path):
    deep = b"[" * 100_000 + b"]" * 100_000
    write_entry(path, b'{"arrays": {}, "tree": ' + deep + b"}")
    assert cache.load(key_of(1), check_cancelled=nothing) is None
    assert not path.exists()


@pytest.mark.parametrize(
    "copied",
    [
        lambda note: store_file.unpack(*store_file.pack([note]))[0],
        lambda note: pickle.loads(pickle.dumps(note)),
    ],
    ids=["cache", "pickle"],
)
def test_a_note_keeps_its_code_and_numbers(copied):
    note = Note("pupil_capped", "capped at 4.5 mm", used_mm=4.5)
    found = copied(note.with_prefix("left eye: "))
    assert found == "left eye: capped at 4.5 mm"
    assert (found.code, found.values) == ("pupil_capped", {"used_mm": 4.5})
