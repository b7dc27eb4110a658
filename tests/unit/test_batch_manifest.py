"""The manifest of a batch: names of any bytes, and other processes in the folder."""

import itertools
import os
import stat

import pytest

from clients.batch.manifest import (
    Manifest,
    ManifestDiffers,
    begin_manifest,
    name_of,
    remove_parts,
    text_of,
    write_summary,
    write_whole,
)
from clients.batch.run import Batch
from clients.batch.source import FieldOfView, Scaled, SourceFrame, States
from clients.batch.work import Job, batch_settings
from clients.frame_log import add_notes, note_line


def test_any_name_becomes_text_and_no_two_the_same():
    letters = (b"\\", b"x", b"e", b"9", b"\xe9", b"\xc3")
    names = {
        os.fsdecode(b"".join(some))
        for count in range(1, 6)
        for some in itertools.product(letters, repeat=count)
    }
    texts = {name: text_of(name) for name in names}
    assert len(set(texts.values())) == len(names)
    for name, text in texts.items():
        assert text.encode("utf-8", "strict")
        assert name_of(text) == name
    assert text_of("caf\u00e9 1.png") == "caf\u00e9 1.png"
    assert text_of("caf\udce9") == r"caf\xe9"


def failed(frame, error="no such file"):
    return {
        **{"kind": "frame", "profile": "eye", "frame": frame, "ok": False},
        **{"error": error, "files": [f"{frame}.png"]},
    }


def test_a_record_of_any_name_is_read_again(tmp_path):
    names = ["caf\udce9", r"caf\xe9", "two\nlines"]
    with Manifest(tmp_path, {}) as manifest:
        for name in names:
            manifest.append(failed(name, f"'{name}': no such file"))
    with Manifest(tmp_path, {}) as manifest:
        for name in names:
            assert manifest.record("eye", name)["frame"] == text_of(name)
        assert len(list(manifest.records())) == 3


def test_reading_leaves_the_line_that_another_process_is_writing(tmp_path):
    with Manifest(tmp_path, {}) as manifest:
        manifest.append(failed("a"))
    path = tmp_path / "manifest.jsonl"
    with path.open("ab") as file:
        file.write(b'{"kind": "frame", "profile": "ey')
    before = path.read_bytes()
    with Manifest(tmp_path, {}, read_only=True) as manifest:
        assert manifest.record("eye", "a")["error"] == "no such file"
    assert path.read_bytes() == before
    with Manifest(tmp_path, {}):
        assert before.startswith(path.read_bytes())  # whole lines


def test_only_the_owner_can_read_profiles(tmp_path):
    (tmp_path / "anew").mkdir()
    begin_manifest(tmp_path / "anew", {"profiles": {}})
    with Manifest(tmp_path, {"profiles": {}}):
        write_summary(tmp_path, {"profiles": {}})
    for path in tmp_path.rglob("manifest.*"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path


def test_a_manifest_that_disappears_is_noticed(tmp_path):
    with Manifest(tmp_path, {}) as manifest:
        manifest.check_in_place()
        content = (tmp_path / "manifest.jsonl").read_bytes()
        (tmp_path / "manifest.jsonl").unlink()
        with pytest.raises(OSError, match=r"manifest\.jsonl' was removed or replaced"):
            manifest.check_in_place()
        (tmp_path / "manifest.jsonl").write_bytes(content)
        with pytest.raises(OSError, match="was removed or replaced"):
            manifest.check_in_place()


def test_only_temporary_files_of_batches_are_removed(tmp_path):
    def killed(path):
        found.append(path.with_suffix(path.suffix + ".copy"))
        found[0].write_bytes(b"half")

    found = []
    write_whole(tmp_path / "inner" / ("x" * 251 + ".png"), killed)
    half = found[0].rename(found[0].with_suffix(""))
    kept = [
        *(".mine.part.txt", ".000.0123456789abcdef.part.png", ".part", "a.part"),
        *(".ocufilter-notes.part.txt", f".ocufilter-{'0' * 32}.txt"),
    ]
    for name in kept:
        (tmp_path / name).write_text("mine")
    (tmp_path / f".ocufilter-{'1' * 32}.part.d").mkdir()
    (tmp_path / f".ocufilter-{'2' * 32}.part.png").symlink_to(tmp_path / "a.part")
    assert remove_parts(tmp_path) == 1
    assert not half.exists()
    assert all((tmp_path / name).read_text() == "mine" for name in kept)
    assert len(list(tmp_path.iterdir())) == len(kept) + 3


def test_a_video_that_changes_after_it_was_hashed_is_noticed(tmp_path):
    video = tmp_path / "c.mkv"
    video.write_bytes(b"one")
    optics = FieldOfView(40.0)
    frame = SourceFrame("0", video, video, optics, Scaled(), 0, 0)
    states = States(4.0, 0.0)
    job = Job({}, batch_settings({}, states), states)
    batch = Batch(job, "video", video, [frame], tmp_path / "out")
    described = batch.described()
    batch.check_videos()
    status = video.stat()
    video.write_bytes(b"two")
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns))
    with pytest.raises(OSError, match=r"c\.mkv' changed during the run"):
        batch.check_videos()
    assert batch.described() == described  # the summary is of the run


def test_a_job_resumes_at_another_time_and_keeps_the_facts_of_its_start(tmp_path):
    job, first = {"format": "png"}, {"created": "2026-01-01", "argv": ["ocufilter"]}
    with Manifest(tmp_path, job, facts=first) as manifest:
        manifest.append(failed("a"))
    later = {"created": "2026-01-02", "argv": ["ocufilter", "batch"]}
    with Manifest(tmp_path, job, facts=later) as manifest:
        assert manifest.record("eye", "a") is not None
        assert manifest.facts == first
    with (
        pytest.raises(ManifestDiffers, match='format is "npy", but was "png"'),
        Manifest(tmp_path, {"format": "npy"}, facts=later),
    ):
        pass


def test_notes_that_differ_in_numbers_are_a_line_with_their_ranges():
    notes = {}
    for far_dpt, shift_dpt in (("0.962", "-0.5"), ("0.949", "-1.25"), ("1.065", "-1")):
        note = f"focus 0.25 dpt is beyond the far point ({far_dpt} dpt), M {shift_dpt}"
        add_notes(notes, [note, "always the same, 1.50"])
    lines = [note_line(note) for note in notes.values()]
    assert lines == [
        "3 frames: focus 0.25 dpt is beyond the far point (0.949 to 1.065 dpt), "
        "M -0.5 to -1.25",
        "3 frames: always the same, 1.50",
    ]
