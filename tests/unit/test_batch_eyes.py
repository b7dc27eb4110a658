"""Eyes of single images in a batch: tables, draws, labels and the estimate of time."""

import csv
import hashlib
import json
import random
import re
import shutil
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from clients.batch.description import batch_of
from clients.batch.dry_run import _Measured, _psnr_db
from clients.batch.eye_table import read_eyes, with_rows
from clients.batch.eyes import MAX_DRAWN, Drawn, narrow_settings, uniform_numbers
from clients.batch.manifest import Manifest
from clients.batch.options import BatchOptions
from clients.batch.refraction import RelaxedEye
from clients.batch.run import missing_units, run_batch
from clients.batch.source import Constant, FieldOfView, SourceFrame, States
from clients.batch.work import UnitRunner
from clients.commands.program import app
from estimator import Eye, InvalidFile, parse_profile
from filter_service import Camera, EyeBank
from filter_service.command_line import exit_code
from filter_service.image_files import read_color
from tests.batch_kills import pictures
from tests.commands import run_command

SIDE_PX, COUNT = 32, 6
FLAT = {"kind": "prescription", "sphere_dpt": -2.0, "cylinder_dpt": -1.0} | {
    "axis_deg": 30.0,
    "higher_order": "none",
    "periphery": "model",
}
PERSON = '{"kind": "prescription", "sphere_dpt": -1, "name": "me"}'
ON_AXIS = '{"mode": "on-axis"}'


def frames_of(*names):
    optics, depth = FieldOfView(5.0), Constant(0.0)
    return [SourceFrame(name, None, None, optics, depth) for name in names]


@pytest.fixture(scope="module")
def classes(tmp_path_factory):
    """Images without depth in folders of classes."""
    folder = tmp_path_factory.mktemp("classes")
    rng = np.random.default_rng(2)
    for number in range(COUNT):
        place = folder / ("cats" if number % 2 else "dogs")
        place.mkdir(exist_ok=True)
        color = rng.integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
        Image.fromarray(color).save(place / f"{number}.png")
    (folder / "dogs/depth").mkdir()
    Image.fromarray(color[..., 0]).save(folder / "dogs/depth/0.png")
    return folder


def options_of(source, out, **more):
    common = {"fov_deg": 5.0, "distance_m": "2", "settings": ON_AXIS}
    return BatchOptions(source=source, out=out, **{**common, **more})


SAMPLED = {
    "profile": [PERSON],
    "sample_eyes": 3,
    "seed": 4,
    "sample_pupil_mm": "3,4",
    "sample_focus_dpt": "0,0.5",
}


class InlinePool:
    """Runs units in this process."""

    def __init__(self, batch):
        self._batch = batch

    def run(self, units):
        runner = UnitRunner(self._batch.job, self._batch.out)
        try:
            for unit in units:
                yield from runner.run(unit)
        finally:
            runner.close()


def finished(batch):
    batch.out.mkdir(exist_ok=True)
    with Manifest(batch.out, batch.described(), facts=batch.facts()) as manifest:
        return run_batch(batch, manifest, InlinePool(batch))


def labels_of(out):
    with (out / "labels.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# Draws


def test_drawn_numbers_are_uniform_and_independent():
    found = np.array([uniform_numbers(1, f"cats/{k}") for k in range(4000)])
    assert found.min() >= 0.0
    assert found.max() < 1.0
    for column in found.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    correlations = np.corrcoef(found.T)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < 4.0 / np.sqrt(4000)
    other = np.array([uniform_numbers(2, f"cats/{k}") for k in range(4000)])
    assert abs(np.corrcoef(found[:, 0], other[:, 0])[0, 1]) < 4.0 / np.sqrt(4000)


def test_drawn_numbers_are_those_of_the_hash():
    """Other programs can compute them; no library may change them."""
    digest = hashlib.sha256(b"7\ncats/1").hexdigest()
    first = Fraction(int(digest[:16], 16) // 2**11, 2**53)
    assert uniform_numbers(7, "cats/1")[0] == float(first)
    assert uniform_numbers(7, "caf\u00e9") == uniform_numbers(7, "cafe\u0301")


def test_an_eye_depends_on_the_name_and_the_seed_alone():
    drawn = Drawn.of(
        *(None, {"me": json.loads(PERSON)}, 50, 10),
        seed=1,
        pupil_range_mm=(3.0, 5.0),
        focus_range_dpt=(0.0, 1.0),
    )
    names = [f"{k}" for k in range(200)]
    all_eyes = {frame.name: frame.eye for frame in drawn.of_frames(frames_of(*names))}
    random.Random(1).shuffle(names)
    for frame in drawn.of_frames(frames_of(*names[:20])):
        assert frame.eye.described() == all_eyes[frame.name].described()
    persons = {eye.profile.sample for eye in all_eyes.values()}
    assert persons <= set(range(10, 60))
    assert len(persons) > 40
    pupils_mm = [eye.states.pupil_mm for eye in all_eyes.values()]
    assert 3.0 <= min(pupils_mm) < 3.05
    assert 4.95 < max(pupils_mm) <= 5.0


# Tables


TABLE = """image,profile,pupil_mm,focus_dpt,distance_m,gaze_h_deg
cats/*,myopia,3.5,center,1,2
dogs/a.png,"{""kind"": ""prescription"", ""sphere_dpt"": -3}",,,inf,
0007,me,,0.5,4,
"""


def table(tmp_path, text):
    path = tmp_path / "eyes.csv"
    path.write_text(text)
    return path


def rows_of(path, **more):
    return read_eyes(path, named={"me": json.loads(PERSON)}, **more)


def with_files(source, *files):
    """Return frames of color files, relative to a folder."""
    optics, depth = FieldOfView(5.0), Constant(0.0)
    return [
        SourceFrame(file.rpartition(".")[0], source / file, None, optics, depth)
        for file in files
    ]


def test_a_table_gives_each_image_its_eye_and_state(tmp_path):
    path = table(tmp_path, TABLE)
    frames = with_files(tmp_path, "cats/x.png", "cats/y.png", "dogs/a.png", "0007.png")
    x, y, dog, number = with_rows(
        *(frames, rows_of(path), States(4.0, None)),
        gaze_deg=(0.0, 1.0),
        path=path,
        source=tmp_path,
    )
    assert x.eye == y.eye
    assert (x.eye.name, x.eye.profile.name) == ("myopia", "myopia")
    assert x.eye.states == States(3.5, 1.0)  # center: at the distance of the pixels
    assert x.depth_form == Constant(1.0)
    assert x.eye.gaze_deg == (2.0, 1.0)
    assert dog.eye.profile.measurements
    assert dog.depth_form == Constant(0.0)
    assert dog.eye.states == States(4.0, 0.0)
    assert (number.eye.name, number.eye.states) == ("me", States(4.0, 0.5))


def test_equal_names_of_different_profiles_are_told_apart(tmp_path):
    bodies = [json.dumps(FLAT | {"sphere_dpt": k}).replace('"', '""') for k in (1, 2)]
    lines = [f'{k},"{body}"' for k, body in enumerate(bodies)]
    path = table(tmp_path, "\n".join(["image,profile", *lines]))
    first, second = (row.eye for row in rows_of(path))
    assert first.name == "profile"
    assert re.fullmatch("profile_[0-9a-f]{8}", second.name)


def test_profiles_are_files_beside_the_table(tmp_path):
    (tmp_path / "one.json").write_text(PERSON)
    (row,) = rows_of(table(tmp_path, "image,profile\na,one.json\n"))
    assert (row.eye.name, row.eye.given) == ("one", json.loads(PERSON))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("image,profile\na,hawk\n", "line 2: profile 'hawk': profile: 'hawk' is not"),
        ("image,pupil_mm\na,\nb,12\n", "line 3: pupil_mm '12'; allowed: 0.5 to 9"),
        ("image,pupil_mm\na,wide\n", "line 2: pupil_mm 'wide'; allowed: 0.5 to 9"),
        ("image,focus_dpt\na,nan\n", "focus_dpt 'nan'; allowed: 0 to 20, or center"),
        ("image,distance_m\na,0.01\n", "line 2: distance_m '0.01'; allowed: 0.05 to"),
        ("image,gaze_h_deg\na,70\n", "line 2: gaze_h_deg '70'; allowed: -60 to 60"),
        ("image,size\na,1\n", "columns image, size; allowed: image, profile"),
        ("image,image\na,b\n", "allowed: each column once"),
        ("image,pupil_mm\na\n", "line 2: another number of cells"),
        ("image,pupil_mm\na,3,4\n", "line 2: another number of cells"),
        ("", "columns none"),
        ("image\n" + "x" * 200_000, "not CSV"),
        ("image\n" + "a\n" * 200_001, "200,002 lines"),
        ("image\n", "no rows"),
        ("image\nz\n", "line 2: image 'z' is none of the images"),
        ("image\nz*\n", "line 2: image 'z*' is none of the images"),
        ("image\na\n*\n", "line 3: '*' matches 'a', as line 2 does"),
        ("image\na\n", "no line for 'b' (1 of 2 images)"),
    ],
)
def test_a_bad_row_is_named(tmp_path, text, words):
    path = table(tmp_path, text)
    with pytest.raises(InvalidFile) as caught:
        with_rows(
            *(with_files(tmp_path, "a.png", "b.png"), rows_of(path), States(4.0, 0.0)),
            gaze_deg=(0.0, 0.0),
            path=path,
            source=tmp_path,
        )
    assert words in str(caught.value)


@pytest.mark.long("compares a thousand globs with a thousand names")
def test_globs_are_limited_in_number(tmp_path):
    names = [f"{k}x" for k in range(1001)]
    path = table(tmp_path, "\n".join(["image", *(f"{name[:-1]}[x]" for name in names)]))
    frames = with_files(tmp_path, *(f"{name}.png" for name in names))
    with pytest.raises(InvalidFile, match="line 1002: more than 1000 globs"):
        with_rows(
            *(frames, rows_of(path), States(4.0, 0.0)),
            gaze_deg=(0.0, 0.0),
            path=path,
            source=tmp_path,
        )


def test_a_row_without_a_profile_needs_one(tmp_path):
    with pytest.raises(InvalidFile, match="line 2: profile ''"):
        read_eyes(table(tmp_path, "image\na\n"), named={})


def test_ranges_are_those_of_the_states():
    found = narrow_settings({}, [3.0, 5.0], [0.5], [0.5, 0.5, 2.0], [(0, 0), (4, -2)])
    assert found.pupil_range_mm == (3.0, 5.0)
    assert found.focus_range_dpt == (0.5, 0.5)
    assert found.object_planes_dpt == (0.5, 2.0)
    assert (found.gaze_deg, found.gaze_range_deg) == ((2.0, -1.0), (2.0, 1.0))
    many = narrow_settings({"mode": "on-axis"}, [4], [0], [0.1, 0.2, 0.3, 0.4, 1.5])
    assert (many.object_planes_dpt, many.object_range_dpt) == ((), (0.1, 1.5))
    assert many.mode == "on-axis"


# Options


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), "--profile is not given; allowed: --profile, --eyes, --sample-eyes or"),
        (("--sample-eyes", 0), f"--sample-eyes is 0; allowed: 1 to {MAX_DRAWN}"),
        (("--sample-eyes", 3, "--bank", "b"), "--sample-eyes and --bank are given"),
        (("-p", "myopia", "--sample-pupil-mm", "3,4"), "allowed with --sample-eyes"),
        (("--sample-eyes", 3, "--sample-pupil-mm", "4,3"), "allowed: LOW,HIGH"),
        (("--sample-eyes", 3, "--sample-focus-dpt", "0,30"), "allowed: 0 to 20"),
        (("--sample-eyes", 3, "--pupil-mm", "3,4"), "several distances, pupils or"),
        (("--sample-eyes", 3, "--people", 3), "--sample-eyes and --people are given"),
        (("--sample-eyes", 3, "--format", "h264"), "allowed: png, npy, exr"),
        (("--sample-eyes", 2, "-p", "arizona"), "nothing to draw"),
        (("--sample-eyes", 9, "--first-person", 999_999), "allowed: up to 999991"),
        (("--bank", "nowhere"), "--bank 'nowhere': no bank"),
        (("--eyes", "nowhere.csv"), "--eyes 'nowhere.csv': no such file"),
    ],
)
def test_options_that_do_not_fit_are_refused(classes, tmp_path, capsys, more, words):
    words_given = [
        *("batch", classes, "--fov-deg", 5, "--distance-m", 2, "-o", tmp_path / "out"),
        *more,
    ]
    assert exit_code(app, [*map(str, words_given)], "ocufilter") == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_table_of_states_may_have_profiles(classes, tmp_path):
    names = sorted(
        p.relative_to(classes).with_suffix("") for p in classes.glob("*/*.png")
    )
    lines = [f"{name},{'me' if k else 'myopia'},3" for k, name in enumerate(names)]
    states = table(tmp_path, "\n".join(["frame,profile,pupil_mm", *lines]))
    batch = batch_of(
        options_of(classes, tmp_path / "out", profile=[PERSON], states=states)
    )
    assert {k: len(v) for k, v in batch.frames_of.items()} == {"myopia": 1, "me": 5}
    assert batch.job.settings.pupil_range_mm == (3.0, 3.0)


def test_rows_without_a_gaze_look_ahead(classes, tmp_path):
    path = table(tmp_path, "image,gaze_h_deg\ncats/*,8\ndogs/*,\n")
    batch = batch_of(
        options_of(
            classes, tmp_path / "out", profile=[PERSON], eyes=path, settings="{}"
        )
    )
    gazes = {frame.name[:4]: frame.eye.gaze_deg for frame in batch.frames}
    assert gazes == {"cats": (8.0, 0.0), "dogs": (0.0, 0.0)}
    settings = batch.job.settings
    assert (settings.gaze_deg, settings.gaze_range_deg) == ((4.0, 0.0), (4.0, 0.0))


def test_distances_of_a_table_need_no_option(classes, tmp_path):
    path = table(tmp_path, "image,distance_m\ncats/*,1\ndogs/*,inf\n")
    given = {"profile": [PERSON], "eyes": path, "focus_dpt": "center"}
    batch = batch_of(options_of(classes, tmp_path / "out", distance_m=None, **given))
    found = {(f.name[:4], f.depth_form.distance_dpt) for f in batch.frames}
    assert found == {("cats", 1.0), ("dogs", 0.0)}
    assert {f.eye.states.focus_dpt for f in batch.frames} == {1.0, 0.0}
    assert batch.job.settings.object_planes_dpt == (0.0, 1.0)
    assert batch.job.settings.focus_range_dpt == (0.0, 1.0)


# Results


@pytest.fixture(scope="module")
def sampled(classes, tmp_path_factory):
    """Images through drawn eyes."""
    out = tmp_path_factory.mktemp("sampled") / "out"
    finished(batch_of(options_of(classes, out, **SAMPLED)))
    return out


@pytest.mark.long("builds three eyes")
def test_a_subset_in_another_order_and_the_rest_have_the_same_bytes(
    classes, sampled, tmp_path
):
    out = tmp_path / "out"
    batch = batch_of(options_of(classes, out, limit=4, **SAMPLED))
    out.mkdir()
    with Manifest(out, batch.described()) as manifest:
        units = missing_units(batch, manifest)[::-1]
        for record in InlinePool(batch).run(units):
            manifest.append(record)
    summary = finished(batch_of(options_of(classes, out, **SAMPLED)))
    assert summary["this_run"]["frames"] == COUNT - 4
    assert pictures(out) == pictures(sampled)
    assert {path.parent.name for path in out.rglob("*.png")} == {"cats", "dogs"}


@pytest.mark.clients
def test_two_workers_make_the_same_bytes(classes, sampled, tmp_path):
    out = tmp_path / "out"
    common = [classes, "-p", PERSON, "--sample-eyes", 3, "--seed", 4, "--fov-deg", 5]
    common += ["--distance-m", 2, "--settings", ON_AXIS, "--sample-pupil-mm", "3,4"]
    common += ["--sample-focus-dpt", "0,0.5", "-o", out, "--workers", 2]
    for more in (["--limit", 3], []):
        told = run_command("batch", *common, *more)
        assert told.returncode == 0, told.stderr
    assert pictures(out) == pictures(sampled)


@pytest.mark.long("builds three eyes twice")
def test_eyes_of_a_bank_make_the_same_bytes(classes, sampled, tmp_path):
    settings = batch_of(options_of(classes, tmp_path / "o", **SAMPLED)).job.settings
    people = [json.loads(PERSON) | {"sample": k} for k in range(3)]
    camera = Camera.from_fov(5.0, width_px=SIDE_PX, height_px=SIDE_PX)
    EyeBank.build(tmp_path / "bank", people, camera, settings, workers=1)
    given = {**SAMPLED, "profile": None, "sample_eyes": None, "settings": "{}"}
    given["bank"] = tmp_path / "bank"
    out = tmp_path / "out"
    finished(batch_of(options_of(classes, out, **given)))
    assert pictures(out) == pictures(sampled)
    wide = options_of(classes, out, **{**given, "sample_pupil_mm": "3,5"})
    with pytest.raises(ValueError, match=r"pupil_range_mm is 3 to 5; allowed: 3 to 4"):
        batch_of(wide)


def test_labels_tell_of_each_image_and_its_eye(classes, sampled):
    rows = labels_of(sampled)
    assert len(rows) == COUNT
    assert {row["source"] for row in rows} == {
        path.relative_to(classes).as_posix() for path in classes.glob("*/*.png")
    }
    assert (sampled / "labels.csv").stat().st_mode & 0o077 == 0
    for row in rows:
        assert read_color(sampled / row["output"]).shape == (SIDE_PX, SIDE_PX, 3)
        which, pupil, focus = uniform_numbers(4, row["source"].removesuffix(".png"))
        assert row["eye"] == f"eye_{int(3 * which):06d}"
        assert int(row["person"]) == int(3 * which)
        assert float(row["pupil_diameter_mm"]) == pytest.approx(3.0 + pupil)
        assert float(row["distance_m"]) == 2.0
        assert row["mode"] == "on-axis"
        requested_dpt = 0.5 * focus
        far_dpt = -float(row["refraction_m_dpt"])  # a myope of 1 dpt sees no farther
        assert float(row["focus_dpt"]) == pytest.approx(
            max(requested_dpt, far_dpt), abs=0.1
        )


@pytest.mark.long("builds an eye")
def test_refraction_in_labels_is_the_prescription(classes, tmp_path):
    """M = S + C / 2, J0 and J45 by Thibos; J45 is in the frame of the eye."""
    path = table(tmp_path, "image,pupil_mm\ncats/*,3\ndogs/*,5\n")
    out = tmp_path / "out"
    finished(
        batch_of(
            options_of(classes, out, profile=[json.dumps(FLAT)], eyes=path, limit=4)
        )
    )
    for row in labels_of(out):
        found = [float(row[f"refraction_{name}_dpt"]) for name in ("m", "j0", "j45")]
        j = 0.5 * np.array([np.cos(np.radians(60.0)), -np.sin(np.radians(60.0))])
        np.testing.assert_allclose(found, [-2.5, *j], atol=0.02)


@pytest.mark.long("traces two eyes in several states")
@pytest.mark.parametrize("body", [{"kind": "synteyes", "sample": 3}, FLAT])
def test_refraction_in_labels_is_that_of_traced_wavefronts(body):
    profile = parse_profile(body)
    relaxed, eye = RelaxedEye(profile), Eye(profile)
    for pupil_mm in (2.1, 3.0, 3.6, 5.5):
        found = relaxed.power_vector(pupil_mm)
        traced = eye.refraction(pupil_diameter_mm=pupil_mm)
        expected = dict(zip(traced.coords["quantity"], traced.values, strict=True))
        for name, value_dpt in found.items():
            assert value_dpt == pytest.approx(expected[name], abs=0.003)
    assert relaxed.power_vector(30.0) is None


@pytest.mark.long("builds two eyes twice")
def test_only_images_whose_rows_have_changed_are_filtered_again(classes, tmp_path):
    path, out = tmp_path / "eyes.csv", tmp_path / "out"
    counts, labels = [], []
    for name, sphere_dpt in (("me", -1), ("myopia", -1), ("myopia", -1), ("me", -2)):
        person = json.dumps(json.loads(PERSON) | {"sphere_dpt": sphere_dpt})
        path.write_text(f"image,profile\ncats/*,me\ndogs/0,{name}\ndogs/[24],me\n")
        batch = batch_of(options_of(classes, out, profile=[person], eyes=path))
        counts.append(finished(batch)["this_run"]["frames"])
        labels.append({row["source"]: row["eye"] for row in labels_of(out)})
    assert counts == [6, 1, 0, 6]
    assert labels[1] == labels[0] | {"dogs/0.png": "myopia"}
    assert labels[3] == labels[0]


@pytest.mark.long("builds an eye twice")
def test_an_image_that_fails_has_no_label_until_it_is_repaired(classes, tmp_path):
    source, out = tmp_path / "source", tmp_path / "out"
    shutil.copytree(classes, source)
    content = (source / "cats/1.png").read_bytes()
    (source / "cats/1.png").write_bytes(content[:100])
    path = table(tmp_path, "image\n*\n")
    for count in (COUNT - 1, COUNT):
        batch = batch_of(options_of(source, out, profile=[PERSON], eyes=path))
        assert len(finished(batch)["failures"]) == COUNT - count
        assert len(labels_of(out)) == count
        (source / "cats/1.png").write_bytes(content)


# The estimate of time


def measured(extra_ms, steady_ms=10.0):
    return _Measured("me", 0.0, [steady_ms] * len(extra_ms), list(extra_ms))


def test_psfs_of_the_first_frames_are_not_multiplied():
    """Times of frames whose extra falls as 1 / k, and of which it stays."""
    harmonic = 100.0 / np.arange(1, 401)
    found = measured(harmonic[:24])
    assert found.extra_s(400) == pytest.approx(harmonic.sum() / 1e3, rel=0.05)
    assert found.extra_s(3) == pytest.approx(harmonic[:3].sum() / 1e3)
    assert found.extra_s(2.5) == pytest.approx((150.0 + 100.0 / 6.0) / 1e3)
    constant = measured([100.0] * 24)
    assert constant.extra_s(400) == pytest.approx(40.0)
    quick = measured([500.0, 20.0, 0.5, 0.1, 0.0, 0.2])
    assert quick.has_few_psfs
    assert quick.extra_s(400) == pytest.approx(0.5208)


def test_a_step_of_8_bits_is_48_db():
    image = np.zeros((4, 4, 3), np.uint8)
    assert _psnr_db(image, image + 1) == pytest.approx(20.0 * np.log10(255.0))
    assert _psnr_db(image, image) == 99.0


@pytest.mark.clients
def test_a_dry_run_says_what_on_axis_would_lose(classes, tmp_path):
    """The PSFs of a field of 1 deg differ less than those of 40 deg."""
    found = []
    for fov_deg in (1, 40):
        told = run_command(
            *("batch", classes, "--sample-eyes", 3, "--fov-deg", fov_deg),
            *("--distance-m", 2, "-o", tmp_path / "out", "--dry-run", "--json"),
        )
        report = json.loads(told.stdout)
        assert report["seconds"] > 0.0
        found.append(report["on_axis"])
    small, large = found
    assert small["worst_psnr_db"] > large["worst_psnr_db"] + 3.0
    for one in found:
        assert one["is_enough"] == (one["worst_psnr_db"] >= 48.1)
