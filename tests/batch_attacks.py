"""Attacks on `ocufilter batch` at random moments, and what must hold after each.

    python -m tests.batch_attacks RUNS [SEED]

starts real batches of small images, attacks each, resumes it and compares: every
result has the bytes of an undisturbed run, every hash in the manifest is that of the
bytes that were read, the user's files are as before, and exit codes tell the truth.
"""

import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from tests.batch_kills import (
    COMMAND,
    MARK,
    kill_now,
    line_count,
    start,
    wait_for_orphans,
    workers_of,
)
from tests.commands import run_command
from tests.source_tree import ROOT

COUNT = 60
WIDTH_PX, HEIGHT_PX = 64, 48
MODE = ("--settings", '{"mode": "on-axis", "eye_model": "wavefront"}')
JOBS = {
    pupil_mm: ("-p", "myopia", *MODE, "--fov-deg", "20", "--pupil-mm", str(pupil_mm))
    for pupil_mm in (4, 5)
}
LIMIT_S = 120.0
OF_OTHERS = (
    *(".mine.part.txt", ".ocufilter-notes.part.txt", "notes.txt"),
    *("myopia/.mine.0123456789abcdef.part.png", "myopia/.part", ".mine/a.part.png"),
)
"""Files of the user in the output folder."""

ODD_NAMES = (
    *(b"caf\xe9", rb"caf\xe9", b"caf\xc3\xa9", b"two\nlines", b"\x1b[31mred"),
    *(b"a\\b", b"a\\\\b", b" space ", b"%s{0}$HOME", b"'\"`;", b"\xff\xfe\xfd"),
    *(b"x" * 250, "\u4e2d".encode() * 83, "\u0130 ".encode() + b"a", b"-p"),
    *("\U0001f441".encode(), b"a.part", b"0.0.0", b"a..b", b"manifest"),
    *(b"\xc3", b"\xed\xb3\xa9", b"tab\there", b"~"),
)


class Undisturbed:
    """Inputs in two versions, and the results of a batch that nobody disturbs.

    Attributes
    ----------
    versions : list of dict
        Content of (color, depth) by frame number.
    results : dict
        Content of a result by pupil and the hashes of its inputs.
    done : Path
        Output folder of the first version.
    """

    def __init__(self, folder):
        rng = np.random.default_rng(7)
        self.versions = [
            {number: _frame(rng, folder) for number in range(COUNT)} for _ in range(2)
        ]
        self.results = {}
        self.done = folder / "4-00/out"
        # Color and depth may be of different versions while both are replaced.
        jobs = [(4, 0, 0), (4, 0, 1), (4, 1, 0), (4, 1, 1), (5, 0, 0)]
        for pupil_mm, *chosen in jobs:
            contents = {
                number: tuple(
                    self.versions[version][number][k]
                    for k, version in enumerate(chosen)
                )
                for number in range(COUNT)
            }
            name = f"{pupil_mm}-{chosen[0]}{chosen[1]}"
            room, out = folder / name / "room", folder / name / "out"
            write_room(room, contents)
            code, _, error = run(room, out, pupil_mm)
            assert code == 0, error
            for number, content in contents.items():
                result = (out / f"myopia/{number:03d}.png").read_bytes()
                self.results[pupil_mm, *map(_hash, content)] = result


def _frame(rng, folder):
    """Return the content of a color and of a depth file."""
    color = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    depth_mm = rng.integers(400, 3000, (HEIGHT_PX // 8, WIDTH_PX // 8))
    depth_mm = np.kron(depth_mm, np.ones((8, 8))).astype(np.uint16)
    contents = []
    for pixels in (color, depth_mm):
        Image.fromarray(pixels).save(folder / "one.png")
        contents.append((folder / "one.png").read_bytes())
    return tuple(contents)


def write_room(room, contents, names=()):
    """Write frames to the folders color/ and depth/."""
    for part in ("color", "depth"):
        (room / part).mkdir(parents=True)
    for number, content in contents.items():
        name = os.fsdecode(names[number]) if number < len(names) else f"{number:03d}"
        for part, one in zip(("color", "depth"), content, strict=True):
            (room / part / f"{name}.png").write_bytes(one)


def _hash(content):
    return hashlib.sha256(content).hexdigest()


def finished(process):
    """Wait for a batch; return its exit code and what it printed."""
    out, error = process.communicate(timeout=LIMIT_S)
    assert "Traceback" not in error, error
    return process.returncode, out, error


def run(room, out, pupil_mm=4, *more):
    """Run a batch to its end; return its exit code and what it printed."""
    told = run_command("batch", room, *JOBS[pupil_mm], "-o", out, *more)
    return told.returncode, told.stdout, told.stderr


def random_moment(process, out, chance):
    """Wait until some frames of a batch are finished, or some time of its start."""
    if chance.random() < 0.2:
        time.sleep(chance.uniform(0.0, 2.0))
        return
    target = line_count(out) + chance.randint(1, COUNT // 2)
    deadline_s = time.monotonic() + LIMIT_S
    while process.poll() is None and line_count(out) < target:
        assert time.monotonic() < deadline_s
        time.sleep(0.001)
    time.sleep(chance.uniform(0.0, 0.005))  # somewhere in the next frame


@contextmanager
def halted(process, out, chance):
    """Stop the workers of a batch at a random moment; let them continue afterward.

    Yields whether any was at work, so that what the test does meets a running batch.
    """
    random_moment(process, out, chance)
    workers = workers_of(out)
    for worker in workers:
        with suppress(ProcessLookupError):
            os.kill(worker, signal.SIGSTOP)
    try:
        yield bool(workers)
    finally:
        for worker in workers:
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGCONT)


def name_in(text):
    r"""Return the file name that a manifest gives as text: \\ is one, \xNN a byte."""
    parts = re.split(r"(\\\\|\\x[0-9a-f]{2})", text)
    plain = [os.fsencode(part) for part in parts]
    for k, part in enumerate(parts):
        if part == r"\\":
            plain[k] = b"\\"
        elif re.fullmatch(r"\\x[0-9a-f]{2}", part):
            plain[k] = bytes([int(part[2:], 16)])
    return os.fsdecode(b"".join(plain))


def records_in(out):
    """Return the job and the last record of each frame, by file name."""
    job, *lines = (out / "manifest.jsonl").read_text(encoding="utf-8").splitlines()
    records = {}
    for line in lines:
        record = json.loads(line)
        json.dumps(record, ensure_ascii=False).encode()  # no lone surrogates
        if record["kind"] == "frame":
            records[name_in(record["frame"])] = record
    return json.loads(job), records


def check_finished(out, room, expected, pupil_mm):
    """Check that a batch is complete and right, by the files as they are now.

    A result may be that of an earlier version of its inputs if its record says so.
    """
    job, records = records_in(out)
    assert job["states"]["pupil_mm"] == pupil_mm
    names = {path.stem for path in (room / "color").iterdir()}
    assert names <= set(records)
    for name in names:
        record = records[name]
        assert record["ok"], record
        content = (out / name_in(record["file"])).read_bytes()
        assert (record["sha256"], record["bytes"]) == (_hash(content), len(content))
        hashes = tuple(one["sha256"] for one in record["inputs"])
        assert expected.results[pupil_mm, *hashes] == content, "a false hash"
    return records


def check_current(out, room, expected, pupil_mm=4):
    """Check that all results are those of the inputs as they are now."""
    records = check_finished(out, room, expected, pupil_mm)
    for path in (room / "color").iterdir():
        recorded = [one["sha256"] for one in records[path.stem]["inputs"]]
        found = [
            _hash((room / part / path.name).read_bytes()) for part in ("color", "depth")
        ]
        assert recorded == found, "an input that changed counts as done"


def resume(out, room, expected, pupil_mm=4):
    """Finish a batch and check it; then a second run has nothing to do."""
    code, told, error = run(room, out, pupil_mm, "--json")
    assert code == 0, error
    check_current(out, room, expected, pupil_mm)
    left = [path.name for path in out.rglob(".ocufilter-*.part*")]
    assert left == [name for name in left if name == ".ocufilter-notes.part.txt"]
    code, told, error = run(room, out, pupil_mm, "--json")
    assert code == 0, error
    assert json.loads(told)["this_run"]["frames"] == 0
    check_current(out, room, expected, pupil_mm)


def plant(out):
    """Put files of the user into an output folder that a batch has begun."""
    if not (out / "manifest.jsonl").exists():
        return {}
    for name in OF_OTHERS:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text(f"of the user: {name}")
    return {out / name: f"of the user: {name}" for name in OF_OTHERS}


def check_planted(planted):
    """Check that the user's files are as before."""
    for path, text in planted.items():
        assert path.read_text() == text


def begin(room, out, chance, pupil_mm=4, *more):
    """Start a batch with one or two workers."""
    n_workers = ("--workers", str(chance.randint(1, 2)))
    job = (*JOBS[pupil_mm], *n_workers, *more)
    return start(room, *job, "-o", out, **{MARK: str(out)})


# --- attacks: each returns what happened --------------------------------------


def killed(folder, expected, chance):
    """SIGKILL once or twice."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    n_killed, planted = 0, {}
    for _ in range(chance.randint(1, 2)):
        process = begin(room, out, chance)
        random_moment(process, out, chance)
        n_killed += kill_now(process, out, chance)
        planted |= plant(out)
    resume(out, room, expected)  # at once, beside workers that are left behind
    check_planted(planted)
    return f"{n_killed} times at work"


def orphaned(folder, expected, chance):
    """SIGKILL the main process; inputs change before its slow workers notice."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    process = begin(room, out, chance)
    with halted(process, out, chance) as were_at_work:
        process.kill()
        process.wait()  # the workers hold its pipes
        planted = plant(out)
        numbers = chance.sample(range(COUNT), chance.randint(COUNT // 2, COUNT))
        _replace(room, numbers, expected.versions[1], in_place=False)
        next_one = begin(room, out, chance)
        time.sleep(chance.uniform(0.0, 4.0))  # of which it waits 3 s for the lock
    process.communicate()
    code, _, error = finished(next_one)
    assert code in (0, 2), error
    if code == 0:
        check_current(out, room, expected)
    wait_for_orphans(out)
    resume(out, room, expected)
    check_planted(planted)
    return f"{'at work' if were_at_work else 'not at work'}, exit code {code}"


def overwritten(folder, expected, chance):
    """A second batch with --overwrite, of the same job or another, beside the first."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    first = begin(room, out, chance)
    pupil_mm = chance.choice((4, 5))
    with halted(first, out, chance) as were_at_work:
        planted = plant(out)
        second = begin(room, out, chance, pupil_mm, "--overwrite")
        second_code, _, error = finished(second)
    codes = finished(first)[0], second_code
    assert codes in ((0, 2), (2, 0), (0, 0)), codes
    if were_at_work:
        assert codes == (0, 2), codes
    if second_code:
        assert "another batch is running there" in error
    pupil_mm = 4 if codes[1] else pupil_mm
    check_finished(out, room, expected, pupil_mm)
    check_planted(planted)
    resume(out, room, expected, pupil_mm)
    return f"{'at work' if were_at_work else 'not at work'}, exit codes {codes}"


def overwriter_killed(folder, expected, chance):
    """SIGKILL a batch with --overwrite on a finished folder of another job."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    shutil.copytree(expected.done, out)
    planted = plant(out)
    process = begin(room, out, chance, 5, "--overwrite")
    if chance.random() < 0.5:  # while it removes files
        while process.poll() is None and (out / "manifest.json").exists():
            if len(list(out.glob("myopia/[0-9]*.png"))) < COUNT - chance.randint(
                0, COUNT
            ):
                break
    else:
        random_moment(process, out, chance)
    was_at_work = kill_now(process, out, chance)
    job, _ = records_in(out)
    pupil_mm = job["states"]["pupil_mm"]
    other = 4 if pupil_mm == 5 else 5
    code, _, error = run(room, out, other)
    assert (code, error.count("\n")) == (2, 1), error
    resume(out, room, expected, int(pupil_mm))
    check_planted(planted)
    return f"the manifest is of the {'new' if pupil_mm == 5 else 'old'} job" + (
        "" if was_at_work else ", finished"
    )


def changed(folder, expected, chance):
    """Inputs are replaced or written again during the run."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    process = begin(room, out, chance)
    numbers = chance.sample(range(COUNT), chance.randint(COUNT // 2, COUNT))
    in_place = chance.random() < 0.5
    with halted(process, out, chance):
        _replace(room, numbers[1:], expected.versions[1], in_place=in_place)
    _replace(room, numbers[:1], expected.versions[1], in_place=in_place)
    code, _, error = finished(process)
    if in_place and code == 1:  # a frame that was written while it was read
        assert "images failed" in error
    else:
        assert code == 0, error
        check_finished(out, room, expected, 4)
    resume(out, room, expected)
    return f"{'in place' if in_place else 'replaced'}, exit code {code}"


def _replace(room, numbers, contents, *, in_place):
    """Write other frames over those of a room, or files of the same times."""
    for number in numbers:
        for part, content in zip(("color", "depth"), contents[number], strict=True):
            path = room / part / f"{number:03d}.png"
            if in_place:
                path.write_bytes(content)
                continue
            new = room / "new"
            new.write_bytes(content)
            status = path.stat()
            os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))
            new.replace(path)


def renamed(folder, expected, chance):
    """Inputs get other names during the run."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    process = begin(room, out, chance)
    with halted(process, out, chance):
        for number in chance.sample(range(COUNT), chance.randint(1, COUNT)):
            for part in ("color", "depth"):
                path = room / part / f"{number:03d}.png"
                path.rename(path.with_name(f"n{number:03d}.png"))
    code, _, error = finished(process)
    before = {path: path.read_bytes() for path in out.glob("myopia/*.png")}
    _, records = records_in(out)
    if code:
        assert (code, "images failed" in error) == (1, True), error
        assert "no such file" in error
        assert not all(record["ok"] for record in records.values())
    else:
        assert all(record["ok"] for record in records.values())
    planted = plant(out)
    resume(out, room, expected)
    assert {path: path.read_bytes() for path in before} == before
    check_planted(planted)
    return f"exit code {code}"


def oddly_named(folder, expected, chance):
    """Names that are not UTF-8, long, or contain line breaks; and a kill."""
    odd = os.fsencode(folder) + chance.choice((b"/o\xe9\n", b"/o\\xe9", b"/o"))
    base = Path(os.fsdecode(odd))
    room, out = base / "room", base / "out"
    write_room(room, expected.versions[0], ODD_NAMES)
    process = begin(room, out, chance)
    random_moment(process, out, chance)
    was_at_work = kill_now(process, out, chance)
    planted = plant(out)
    resume(out, room, expected)
    check_planted(planted)
    return "killed" if was_at_work else "finished"


def disk_full(folder, expected, chance):
    """Files may have some size only, or the file system is small."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    limit_bytes = int(10 ** chance.uniform(2.3, 5.5))
    is_small_disk = chance.random() < 0.5 and _can_mount()
    if is_small_disk:
        kept = folder / "kept"
        out.mkdir()
        limit = -(-limit_bytes // 4096) * 4096
        script = (
            f'mount -t tmpfs -o size={limit} tmpfs "$1" || exit 99; out="$1"; '
            'kept="$2"; shift 2; "$@"; code=$?; cp -a "$out" "$kept"; exit $code'
        )
        unshare = ["unshare", "-rm", "sh", "-c", script, "sh", str(out), str(kept)]
        process = _popen([*unshare, *COMMAND, str(room), *JOBS[4], "-o", str(out)])
    else:
        kept = out
        limits = (limit_bytes, limit_bytes)
        set_limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, limits)
        command = [*COMMAND, str(room), *JOBS[4], "-o", str(out)]
        process = _popen(command, preexec_fn=set_limit)
    code, _, error = finished(process)
    assert code in (0, 1), error
    if code == 0:
        check_finished(kept, room, expected, 4)
    else:
        assert error.startswith(("batch: ", "ocufilter: "))
    planted = plant(kept)
    resume(kept, room, expected)
    check_planted(planted)
    return f"{'small disk' if is_small_disk else 'file size'}, exit code {code}"


def _popen(command, **how):
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, **how
    )


def _can_mount():
    command = ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    try:
        return not subprocess.run(command, capture_output=True, check=False).returncode
    except OSError:
        return False


def two_at_once(folder, expected, chance):
    """The same command two or three times, within two seconds."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    processes = []
    for _ in range(chance.randint(2, 3)):
        processes.append(begin(room, out, chance))
        time.sleep(chance.choice((0.0, chance.uniform(0.0, 2.0))))
    codes = []
    for process in processes:
        code, _, error = finished(process)
        codes.append(code)
        if code:
            assert "another batch is running there" in error
    assert 0 in codes
    assert set(codes) <= {0, 2}
    check_finished(out, room, expected, 4)
    planted = plant(out)
    resume(out, room, expected)
    check_planted(planted)
    return f"exit codes {sorted(codes)}"


def damaged(folder, expected, chance):
    """Results are lost, filled with zeros or cut, in a batch that was killed or not."""
    room, out = folder / "room", folder / "out"
    write_room(room, expected.versions[0])
    shutil.copytree(expected.done, out)
    planted = plant(out)
    for path in chance.sample(sorted(out.glob("myopia/[0-9]*.png")), 6):
        size = path.stat().st_size
        how = chance.choice(("lost", "zeros", "cut", "bit"))
        content = bytearray(path.read_bytes())
        content[chance.randrange(size)] ^= 1 << chance.randrange(8)
        if how == "lost":
            path.unlink()
        else:
            content = {"zeros": bytes(size), "cut": content[:-1], "bit": content}[how]
            path.write_bytes(content)
    process = begin(room, out, chance)
    random_moment(process, out, chance)
    was_at_work = kill_now(process, out, chance)
    resume(out, room, expected)
    check_planted(planted)
    return "killed" if was_at_work else "finished"


ATTACKS = (
    *(killed, orphaned, overwritten, overwriter_killed, changed, renamed, oddly_named),
    *(disk_full, two_at_once, damaged),
)


def attack_once(attack, seed, folder, expected):
    """Attack a batch in a new folder; return what happened.

    Raises
    ------
    AssertionError
        If something was lost or is wrong.  The folder stays.
    """
    own = folder / f"{attack.__name__}-{seed}"
    own.mkdir()
    happened = attack(own, expected, random.Random(f"{attack.__name__} {seed}"))
    for out in (path for path in own.rglob("out") if path.is_dir()):
        wait_for_orphans(out)
    shutil.rmtree(own)
    return happened


def main(argv):
    """Attack as often as requested; print what happened, by kind."""
    n_runs, seed = int(argv[0]), int(argv[1]) if len(argv) > 1 else 0
    counts, n_failed = Counter(), 0
    folder = Path(tempfile.mkdtemp(prefix="batch-attacks-"))
    expected = Undisturbed(folder)
    for number in range(n_runs):
        attack = ATTACKS[number % len(ATTACKS)]
        own_seed = seed + number // len(ATTACKS)
        try:
            happened = attack_once(attack, own_seed, folder, expected)
        except (AssertionError, KeyError, OSError, ValueError) as error:
            n_failed += 1
            happened = f"FAILED: {type(error).__name__}"
            text = str(error)[:400]
            print(f"{attack.__name__} {own_seed}: {text!r}", flush=True)
        counts[attack.__name__, happened] += 1
    for (kind, happened), count in sorted(counts.items()):
        print(f"{count:4d}  {kind:18s} {happened}")
    print(f"{n_runs} runs, {n_failed} failed")
    if not n_failed:
        shutil.rmtree(folder)
    return 1 if n_failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
