"""Offline filtering of a data set: frames per second and core, with image error.

    python -m tests.benchmarks.bench_batch [--quick] [--json]
        [--sizes WxH ...] [--eyes NAME ...] [--frames N] [--no-kills]

`ocufilter batch` on the demo's walk through *Courtyard*: 8-bit PNG of colour and 16-bit
PNG of depth in mm from files, pupil and focus from a list, another in every frame, PNG
to files; over the whole visual field.  One worker, two, and one with two threads.  A
row's time is wall time of the batch for each frame, without its first frames and so
without the preparation of the eye; "cpu" is processor time in the worker, which other
work on the machine changes less; "read", "filter" and "write" are wall times of the
parts.

The error is that of one picture, in linear light and read from its files (depth in mm
is part of it), against the dense reference of `bench live`, in three windows of 64 x 64
px: middle, left edge, corner.  A million frames: in core-hours, by wall time and by
processor time.

Then a batch is killed 20 times by SIGKILL at random moments, workers with it or left
behind, and finished: what is lost, half written or another.

What others do with the machine in the second before stands beside each figure; "busy"
where that is more than a tenth of it.

Writes results/batch.json.
"""

import argparse
import json
import random
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from clients.batch.manifest import Manifest
from clients.batch.pools import ProcessPool
from clients.batch.run import Batch, run_batch
from clients.batch.source import FieldOfView, Scaled, SourceFrame, States
from clients.batch.work import Job, batch_settings
from clients.commands.options import read_size_px
from filter_service import EyeFilter, RgbdView
from filter_service.image_files import read_color, read_depth
from tests.batch_kills import kill, pictures, start, wait_for_orphans
from tests.benchmarks.harness import (
    RESULTS,
    Row,
    machine_info,
    memory_mb,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.live_walk import Judge, Walk
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.view_sources import Window

MILLION = 1e6
MS_PER_HOUR = 3.6e6
N_KILLS = 20
FARTHEST_MM = 65535
WARM_FRAMES = 8
"""Of each worker; what comes before is preparation."""

WAYS = {"1 worker": (1, 1), "2 workers": (2, 1), "1 worker, 2 threads": (1, 2)}
FOV_DEG = 50.0
WINDOW_PX = 64
BUSY_RATIO = 0.1


@dataclass(frozen=True)
class Rate:
    """What one way to run a batch costs, as plain numbers."""

    eye: str
    size: str
    way: str
    frames: int
    frames_per_s: float
    frames_per_s_and_core: float
    core_hours_per_million: float
    cpu_hours_per_million: float
    psnr_db: float
    others_ratio: float
    is_busy: bool


def _work_of_others() -> float:
    """Return the share of all processors that is at work while we sleep for 1 s."""
    before = _processor_times()
    time.sleep(1.0)
    spent = [
        after - first for after, first in zip(_processor_times(), before, strict=True)
    ]
    idle = spent[3] + spent[4]  # and waiting for a disk
    return 1.0 - idle / max(sum(spent), 1)


def _processor_times() -> list[int]:
    with open("/proc/stat", encoding="ascii") as stat:
        return [int(ticks) for ticks in stat.readline().split()[1:9]]


def write_walk(walk: Walk, folder: Path, count: int) -> list[SourceFrame]:
    """Write the frames of a walk as files, over and over up to a count."""
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True)
    frames = []
    for number in range(count):
        view = walk.views[number % len(walk.views)]
        color, depth = (folder / p / f"{number:05d}.png" for p in ("color", "depth"))
        Image.fromarray(view.color).save(color)
        depth_mm = np.minimum(1e3 * view.depth_m.astype(np.float64), FARTHEST_MM)
        Image.fromarray(np.rint(depth_mm).astype(np.uint16)).save(depth)
        optics = FieldOfView(np.degrees(2.0 * np.arctan(view.tangents[2])))
        frames.append(SourceFrame(f"{number:05d}", color, depth, optics, Scaled()))
    return frames


def job_of(walk: Walk, frames: list[SourceFrame], eye: str) -> Job:
    """Return the job of an eye: the walk's states."""
    listed = {
        frame.name: tuple(walk.states[k % len(walk.states)].values())
        for k, frame in enumerate(frames)
    }
    states = States(4.0, 0.0, listed)
    profile = {"kind": "preset", "name": eye}
    return Job({eye: profile}, batch_settings({}, states), states)


class _Exact:
    """A job's filter as the judge asks for it."""

    def __init__(self, job: Job, eye: str, frame: SourceFrame) -> None:
        self._job, self._profile, self._frame = job, job.profiles[eye], frame
        self._filter = EyeFilter(engine=job.engine)

    def render(self, view, handle, *, pupil_diameter_mm, focus_dpt, render_tolerance):
        """Return the picture in linear light, from the files of the frame."""
        own = RgbdView(
            read_color(self._frame.color), read_depth(self._frame.depth), view.tangents
        )
        self._filter.set_profile(
            self._profile, settings=self._job.settings, cameras=[view.camera]
        )
        self._filter.wait()
        return self._filter.filter(
            own,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            output=self._job.output,
            render_tolerance=self._job.render_tolerance,
        )

    def close(self) -> None:
        """Give up what is held."""
        self._filter.close()


def windows_of(size_px: tuple[int, int]) -> list[Window | None]:
    """Return the parts of a frame that are judged."""
    (width_px, height_px), side_px = size_px, WINDOW_PX
    if height_px <= side_px:
        return [None]
    middle_y = (height_px - side_px) // 2
    corners = [
        ((width_px - side_px) // 2, middle_y),
        (0, middle_y),
        (width_px - side_px, height_px - side_px),
    ]
    return [Window(x, y, side_px, side_px) for x, y in corners]


def error_db(walk: Walk, frames: list[SourceFrame], eye: str) -> float:
    """Return the error of the judged frame."""
    job = replace(job_of(walk, frames, eye), format="npy")
    exact = _Exact(job, eye, frames[walk.judged])
    try:
        windows = windows_of(walk.size_px)
        judge = Judge.of(walk, eye, compute=True, windows=windows)
        return judge.error_db(exact, None, 1.0)
    finally:
        exact.close()


def measured(
    job: Job, frames: list[SourceFrame], way: str, psnr_db: float
) -> tuple[Rate, list[Row]]:
    """Run a batch one way; return what it costs."""
    (eye,) = job.profiles
    n_workers, n_threads = WAYS[way]
    others_ratio = _work_of_others()
    done_s: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        batch = Batch(job, "pairs", frames[0].color.parents[1], frames, out)
        pool = ProcessPool(job, out, n_workers=n_workers, n_threads=n_threads)
        with Manifest(out, batch.described()) as manifest:
            run_batch(
                batch,
                manifest,
                pool,
                on_done=lambda n_done, n_all: done_s.append(time.perf_counter()),
            )
            records = [manifest.record(eye, frame.name) for frame in frames]
    failed = [record["error"] for record in records if not record["ok"]]
    if failed:
        raise RuntimeError(failed[0])
    size = "x".join(map(str, Image.open(frames[0].color).size))
    first = min(WARM_FRAMES * n_workers, len(frames) // 2)
    wall_ms = 1e3 * (done_s[-1] - done_s[first]) / (len(done_s) - 1 - first)
    warm = [record for record in records if "build" not in record["ms"]]
    cpu_ms = [record["cpu_ms"] for record in warm]
    n_cores = n_workers * n_threads
    rate = Rate(
        eye=eye,
        size=size,
        way=way,
        frames=len(done_s) - 1 - first,
        frames_per_s=round(1e3 / wall_ms, 2),
        frames_per_s_and_core=round(1e3 / wall_ms / n_cores, 2),
        core_hours_per_million=round(wall_ms * n_cores * MILLION / MS_PER_HOUR, 2),
        cpu_hours_per_million=round(
            float(np.median(cpu_ms)) * MILLION / MS_PER_HOUR, 2
        ),
        psnr_db=round(psnr_db, 2),
        others_ratio=round(others_ratio, 2),
        is_busy=others_ratio > BUSY_RATIO,
    )
    parts = {
        "frame": np.diff(done_s[first:]) * 1e3,
        "  cpu": cpu_ms,
        **{
            f"  {part}": [record["ms"][part] for record in warm]
            for part in ("read", "filter", "write")
        },
    }
    rows = [_row(rate, part, times, wall_ms) for part, times in parts.items()]
    return rate, rows


def _row(rate: Rate, part: str, times_ms, wall_ms: float) -> Row:
    reference = "dense, over the field, bins of 0.2 deg and 0.005 dpt"
    return Row(
        bench="batch",
        method=part,
        case=rate.eye,
        setting=f"{rate.size} {rate.way}" + (", busy" if rate.is_busy else ""),
        n=len(times_ms),
        median_ms=wall_ms if part == "frame" else float(np.median(times_ms)),
        p95_ms=float(np.percentile(times_ms, 95)),
        memory_mb=memory_mb(),
        error_name="psnr_db",
        error=rate.psnr_db,
        reference=reference,
    )


def kills(folder: Path, walk: Walk, n_kills: int) -> dict:
    """Kill a batch again and again, finish it; compare it with an undisturbed one."""
    count = 12 * n_kills
    write_walk(walk, folder / "room", count)
    room, chance = folder / "room", random.Random(n_kills)
    arguments = (room, "-p", "myopia", "--fov-deg", FOV_DEG, "--workers")
    expected, out = folder / "undisturbed", folder / "killed"
    _finish(*arguments, 1, "-o", expected)
    n_hit = sum(kill((*arguments, 2), out, chance) for _ in range(n_kills))
    _finish(*arguments, 2, "-o", out)
    with suppress(TimeoutError):
        wait_for_orphans(out)
    _finish(*arguments, 2, "-o", out)
    before, after = pictures(expected), pictures(out)
    return {
        "kills": n_kills,
        "at_work_when_killed": n_hit,
        "frames": count,
        "lost": len(before.keys() - after.keys()),
        "left_over": len(after.keys() - before.keys()),
        "other_bytes": sum(before[name] != after.get(name) for name in before),
    }


def _finish(*arguments) -> None:
    process = start(*arguments)
    _, error = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(error)


def main(argv: list[str] | None = None) -> None:
    """Run, print, and write tests/benchmarks/results/batch.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one eye, 96x54, 2 kills")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--eyes", nargs="+", choices=CONDITIONS)
    parser.add_argument("--sizes", nargs="+", type=read_size_px, metavar="WxH")
    parser.add_argument("--frames", type=int, metavar="N", help="96, of 720p 48")
    parser.add_argument("--no-kills", action="store_true")
    options = parser.parse_args(argv)
    eyes = options.eyes or ["myopia", "keratoconus"]
    sizes = options.sizes or [(480, 270), (1280, 720)]
    if options.quick:
        eyes, sizes = eyes[:1], [(96, 54)]
    rates: list[Rate] = []
    rows: list[Row] = []
    for size_px in sizes:
        is_small = size_px[0] < 1000
        walk = Walk.of(size_px, 24 if is_small else 12)
        count = options.frames or (96 if is_small else 48)
        with tempfile.TemporaryDirectory() as folder:
            frames = write_walk(walk, Path(folder) / "room", count)
            for eye in eyes:
                psnr_db = error_db(walk, frames, eye)
                job = job_of(walk, frames, eye)
                for way in WAYS:
                    rate, more = measured(job, frames, way, psnr_db)
                    rates.append(rate)
                    rows += more
                    print(json.dumps(asdict(rate)), file=sys.stderr, flush=True)
    content = report(rows, machine=machine_info())
    content["rates"] = [asdict(rate) for rate in rates]
    if not options.no_kills:
        with tempfile.TemporaryDirectory() as folder:
            walk = Walk.of((96, 54), 24)
            n_kills = 2 if options.quick else N_KILLS
            content["kills"] = kills(Path(folder), walk, n_kills)
    if options.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    print(json.dumps(content.get("kills")))
    if not options.quick:
        print(write_report("batch", content).relative_to(RESULTS.parents[2]))


if __name__ == "__main__":
    main()
