"""Banks of prebuilt eyes: the same bytes, and what damaged or foreign files do."""

import json
import multiprocessing
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.commands.program import app
from filter_service import EyeBank, EyeFilter, FilterSettings
from filter_service.building import eye_bank
from filter_service.camera import Camera
from filter_service.errors import BadMessage, BuildFailed

CAMERA = Camera.from_fov(8.0, width_px=64, height_px=48)
RANGES = {
    "pupil_range_mm": (3.0, 4.0),
    "focus_range_dpt": (0.0, 0.5),
    "object_planes_dpt": (0.5,),
}
SETTINGS = FilterSettings(**RANGES)
PEOPLE = [
    {"kind": "prescription", "sphere_dpt": -0.5, "age_years": 30.0, "sample": number}
    for number in range(2)
]
STATES = (
    {"pupil_diameter_mm": 3.3, "focus_dpt": 0.1},
    {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5},
)

long = pytest.mark.long("builds eyes in a process")


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    return EyeBank.build(
        tmp_path_factory.mktemp("banks") / "bank", PEOPLE, CAMERA, SETTINGS, workers=1
    )


@pytest.fixture
def copied(bank, tmp_path):
    """Return the folder of a copy, which a test may damage."""
    return shutil.copytree(bank.folder, tmp_path / "bank", copy_function=shutil.copy2)


@pytest.fixture(scope="module")
def frame():
    color = np.random.default_rng(3).integers(0, 256, (48, 64, 3), np.uint8)
    return color, np.full((48, 64), 2.0, np.float32)


def images(profiles, frame, **options):
    """Return the images (n, 2, height, width, 3) through profiles in two states."""
    options = {"settings": SETTINGS, "worker": False} | options
    with EyeFilter(camera=CAMERA, engine="native", **options) as eye_filter:
        found = []
        for profile in profiles:
            eye_filter.set_profile(profile)
            found.append(
                [eye_filter.filter(*frame, **s, whole=True).color for s in STATES]
            )
    return np.array(found)


@pytest.fixture(scope="module")
def expected(frame):
    """Return the images without a bank."""
    return images(PEOPLE, frame)


@long
@pytest.mark.parametrize("worker", [False, True])
def test_images_have_the_same_bytes_as_without_a_bank(bank, frame, expected, worker):
    np.testing.assert_array_equal(images(bank, frame, worker=worker), expected)
    assert np.any(expected[0] != expected[1])  # two persons
    assert np.any(expected[:, 0] != expected[:, 1])  # two states


def test_a_bank_is_a_sequence_of_private_files(bank):
    assert len(bank) == 2
    assert bank[-1].path == bank[1].path != bank[0].path
    assert [eye.sample for eye in bank[:]] == [0, 1]
    assert bank.camera == CAMERA
    assert bank.settings == SETTINGS
    with pytest.raises(IndexError):
        bank[2]
    files = sorted(bank.folder.iterdir())
    assert [f.name for f in files] == [
        "bank.psfs",
        "eye_000000.psfs",
        "eye_000001.psfs",
    ]
    assert all(f.stat().st_mode & 0o077 == 0 for f in (bank.folder, *files))
    size_mb = sum(f.stat().st_size for f in files) / 1e6
    assert bank.size_mb == pytest.approx(size_mb)
    assert size_mb / 2 < 5.0


@long
def test_an_interrupted_build_continues(bank, copied):
    kept, missing = (copied / f"eye_00000{k}.psfs" for k in range(2))
    before, changed_ns = missing.read_bytes(), kept.stat().st_mtime_ns
    missing.unlink()
    kept_bytes = kept.read_bytes()
    again = EyeBank.build(copied, bank, CAMERA, SETTINGS, workers=1)
    assert len(again) == 2
    assert kept.read_bytes() == kept_bytes
    assert kept.stat().st_mtime_ns == changed_ns
    # times of the estimation are part of the notes, so only the arrays are compared
    start = int.from_bytes(before[16:24], "little")
    assert missing.read_bytes()[-len(before) + start :] == before[start:]


def test_another_bank_is_not_overwritten(bank, copied):
    for people, settings in (
        (PEOPLE[:1], SETTINGS),
        (PEOPLE[::-1], SETTINGS),
        (PEOPLE, SETTINGS.changed(tolerance="loose")),
    ):
        with pytest.raises(BadMessage, match="contains a bank of other eyes"):
            EyeBank.build(copied, people, CAMERA, settings)


@pytest.mark.parametrize("at_ratio", [0.0, 0.01, 0.5, 0.999])
def test_a_damaged_file_is_an_error_that_names_it(copied, frame, at_ratio):
    path = copied / "eye_000000.psfs"
    content = bytearray(path.read_bytes())
    content[int(at_ratio * len(content))] ^= 1
    path.write_bytes(content)
    with pytest.raises(BuildFailed, match=r"eye_000000.psfs' cannot be read"):
        images(EyeBank(copied)[:1], frame)


def test_truncated_and_missing_files_are_errors(copied, frame):
    path = copied / "eye_000001.psfs"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BuildFailed, match="expected"):
        images(EyeBank(copied)[1:], frame)
    path.unlink()
    with pytest.raises(BuildFailed, match=r"EyeBank.build completes it"):
        images(EyeBank(copied)[1:], frame)
    (copied / "bank.psfs").write_bytes(b"no bank")
    with pytest.raises(BadMessage, match="damaged or of another version"):
        EyeBank(copied)
    (copied / "bank.psfs").unlink()
    with pytest.raises(FileNotFoundError):
        EyeBank(copied)


def test_another_version_must_be_built_again(bank, frame, monkeypatch):
    eye = bank[0]
    monkeypatch.setattr(eye_bank, "code_version", lambda: "of other code")
    with pytest.raises(BadMessage, match=r"another version .* build it again"):
        EyeBank(bank.folder)
    with pytest.raises(BuildFailed, match="another version"):
        images([eye], frame)


def test_frames_must_suit_the_bank(bank, frame):
    with pytest.raises(BuildFailed, match=r"settings.pupil_range_mm.*bank"):
        images(bank[:1], frame, settings=SETTINGS.changed(pupil_range_mm=(3.0, 5.0)))
    wide = Camera.from_fov(9.0, width_px=64, height_px=48)
    with (
        EyeFilter(
            camera=wide, settings=SETTINGS, engine="native", worker=False
        ) as eye_filter,
        pytest.raises(BuildFailed, match=r"camera: .*the bank"),
    ):
        eye_filter.set_profile(bank[0])
        eye_filter.wait()


@long
def test_an_eye_that_cannot_be_built_is_named(tmp_path):
    lens = {"kind": "iol", "design": "bifocal", "add_dpt": 3.0}
    person = {"kind": "prescription", "sphere_dpt": 0.0, "correction": lens}
    with pytest.raises(BuildFailed, match=r"eye 1: settings.diffraction"):
        EyeBank.build(
            tmp_path / "bank",
            [PEOPLE[0], person],
            CAMERA,
            SETTINGS.changed(mode="on-axis", diffraction=False),
            workers=1,
        )
    with pytest.raises(BadMessage, match="profiles: "):
        EyeBank.build(tmp_path / "none", [], CAMERA)


@long
def test_the_command_builds_a_bank_of_drawn_persons(tmp_path):
    folder = tmp_path / "people"
    settings = SETTINGS.changed(mode="on-axis")
    arguments = (
        *("bank", folder, "-p", json.dumps(PEOPLE[0]), "--people", 2),
        *("--fov-deg", 8, "--size", "64x48", "--settings"),
        json.dumps({"mode": "on-axis", **RANGES}),
    )
    ended = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert ended.exit_code == 0, ended.output
    bank = EyeBank(folder)
    assert json.loads(ended.stdout)["eyes"] == len(bank) == 2
    assert (bank.camera, bank.settings) == (CAMERA, settings)
    assert [eye.sample for eye in bank] == [0, 1]


def _seen(folder, frame, results):
    found = images(EyeBank(folder), frame)
    results.put((found, "scipy" in sys.modules))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@long
def test_processes_share_the_memory_of_files(bank, frame, expected):
    """They need no SciPy, which is 0.2 s of the start, and 24 MB of each process."""
    spawn = multiprocessing.get_context("spawn")
    results = spawn.SimpleQueue()
    process = spawn.Process(target=_seen, args=(bank.folder, frame, results))
    process.start()
    store = eye_bank.BankStore(bank[0].path)
    found, uses_scipy = results.get()
    np.testing.assert_array_equal(found, expected)
    assert not uses_scipy
    process.join()
    maps = [
        line.split()[1]
        for line in Path("/proc/self/maps").read_text().splitlines()
        if line.endswith(store.path)
    ]
    assert set(maps) == {"r--s"}  # read-only and shared
    assert not store._banked.weights.flags.writeable
