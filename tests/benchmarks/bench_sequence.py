"""Flicker: change of the error over paths of 120 frames.

    python -m tests.benchmarks.bench_sequence [--quick] [--json] [--plot]
        [--motions NAME ...] [--modes NAME ...] [--engine NAME]

The camera moves, the pupil opens from 2.5 to 6.5 mm, focus goes from 0 to 4 dpt, the
gaze turns, or nothing moves at all.  A frame's error is its difference to the dense
reference of that very moment: the whole frame on axis, two windows over the field.
Flicker is the RMS of the change of the error from one frame to the next; its worst
frame is given in dB below white, with the 99.9th percentile of its pixels.  Popping is
the largest change over the median of its neighbours'.

The same path is rendered with kernels made anew for every frame, without merging, and
then with finer layers, finer nodes of the cache and smaller cells one after the other:
what a change removes is its mechanism's share.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from filter_service.psfs.store import build_psf_store
from tests.benchmarks.engines import ENGINES, renderer_maker, working_memory_mb
from tests.benchmarks.harness import (
    OUT,
    RESULTS,
    Row,
    machine_info,
    report,
    write_report,
)
from tests.benchmarks.sequences import (
    FRAME_COUNT,
    GAZE_RANGE_DEG,
    Flicker,
    Moment,
    compared,
    decibels,
    eye_spec,
    flicker,
    path,
    truth,
)
from tests.numerical.plan_cases import traced_eye

MOTIONS = ("camera", "pupil", "focus", "gaze", "static")
MODES = ("on-axis", "dynamic")
EYES = {"on-axis": "myopia", "dynamic": "keratoconus"}
FOCUSING_EYES = {"on-axis": "emmetropia", "dynamic": "post_lasik"}
"""Much merges for the myope, much changes over the field for the keratoconus; neither
accommodates to most of the path of the focus."""

QUICK_FRAMES = (50, 56)

STILL_DB = 100.0
"""Plots end here."""

MIN_FLICKER_DB = {"on-axis": 52.0, "dynamic": 46.0}
"""Bounds on the worst change, chosen: 46 dB is half a per cent of white; on the axis
half of that."""

MAX_POPPING_RATIO = 2.0
"""Bound on a change against its neighbours', where it could be seen at all."""


@dataclass(frozen=True)
class Variant:
    """The renderer with a mechanism switched off.

    Attributes
    ----------
    is_fresh : bool
        A new renderer for every frame: nothing is left from the last one.
    """

    merge: bool = True
    is_fresh: bool = False
    mode: str | None = None
    settings: tuple = ()


FINE_LAYERS = (("max_blur_step_px", 0.125),)
FINE_NODES = (*FINE_LAYERS, ("tolerance", "fine"))
VARIANTS = {
    "ours": Variant(),
    "fresh kernels": Variant(is_fresh=True),
    "unmerged": Variant(merge=False),
    "unmerged, fine layers": Variant(merge=False, settings=FINE_LAYERS),
    "unmerged, fine nodes": Variant(merge=False, mode="dynamic", settings=FINE_NODES),
    "unmerged, fine cells": Variant(merge=False, mode="quality", settings=FINE_NODES),
}


@dataclass(frozen=True)
class SequenceRow(Row):
    """A path; ``error`` is its worst change, dB below white.

    Attributes
    ----------
    psnr_db : float
        Of the worst frame.
    median_flicker_db : float
        Of the median change.
    pixel_999_ratio : float
        99.9th percentile over pixels of the worst change, in parts of white.
    popping_ratio, jump_ratio : float
        Largest change over the median of its neighbours', among changes that could be
        seen, and among all.
    worst_frame, jump_frame : int
    """

    psnr_db: float
    median_flicker_db: float
    pixel_999_ratio: float
    popping_ratio: float
    jump_ratio: float
    worst_frame: int
    jump_frame: int
    flicker_db: list[float]


class SequenceBench:
    """Renders paths through one eye in all variants."""

    def __init__(self, new_renderer: Callable, mode: str, eye: str):
        self.new_renderer, self.mode, self.eye = new_renderer, mode, eye
        self.renderer = new_renderer()
        self._stores = {}

    def frames(self, moments: tuple[Moment, ...], variant: Variant, gaze: bool) -> list:
        """Frames of a path with their times, ms."""
        handle = self._store(moments, variant, gaze)
        self.renderer = self.new_renderer()
        frames = []
        for moment in moments:
            if variant.is_fresh:
                self.renderer = self.new_renderer()
            options = {"gaze_deg": moment.gaze_deg} if gaze else {}
            start_s = time.perf_counter()
            frame = self.renderer.render(
                moment.view,
                handle,
                pupil_diameter_mm=moment.pupil_mm,
                focus_dpt=moment.focus_dpt,
                merge=variant.merge,
                **options,
            )
            frames.append((frame.color, 1e3 * (time.perf_counter() - start_s)))
        return frames

    def _store(self, moments: tuple[Moment, ...], variant: Variant, gaze: bool):
        """Store for all pupils and foci of the paths, or the finest for this one's."""
        settings = dict(variant.settings)
        if gaze or variant.mode:
            settings |= {
                "pupil_range_mm": _range([moment.pupil_mm for moment in moments]),
                "focus_range_dpt": _range([moment.focus_dpt for moment in moments]),
            }
        if gaze:
            settings["gaze_range_deg"] = GAZE_RANGE_DEG
        mode = variant.mode or self.mode
        key = (mode, *settings.items())
        if key not in self._stores:
            spec = eye_spec(moments[0].view, mode, **settings)
            store = build_psf_store(traced_eye(self.eye, spec), spec)
            self._stores[key] = self.renderer.load(store)
        return self._stores[key]

    def release(self) -> None:
        """Free the stores on the GPU."""
        for handle in self._stores.values():
            handle.release()
        self._stores.clear()


def _range(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def variants_of(mode: str) -> dict[str, Variant]:
    """On axis there are no cells."""
    return {
        name: variant
        for name, variant in VARIANTS.items()
        if mode != "on-axis" or variant.mode is None
    }


def path_errors(
    bench: SequenceBench,
    motion: str,
    part: tuple[int, int],
    variant: Variant | None = None,
    times_ms: list | None = None,
) -> list[list[np.ndarray]]:
    """Errors of a path's frames, part by part; ``times_ms`` is added to."""
    moments = path(motion, *part)
    errors = []
    frames = bench.frames(moments, variant or VARIANTS["ours"], gaze=motion == "gaze")
    for moment, (color, time_ms) in zip(moments, frames, strict=True):
        pairs = zip(
            compared(color, bench.mode),
            truth(bench.eye, moment, bench.mode),
            strict=True,
        )
        errors.append([ours - exact for ours, exact in pairs])
        if times_ms is not None:
            times_ms.append(time_ms)
    return errors


def bench_motion(bench, motion: str, part: tuple[int, int], methods) -> list[Row]:
    """Rows of a path, one a variant."""
    rows = []
    for name, variant in variants_of(bench.mode).items():
        if methods and name not in methods:
            continue
        times_ms = []
        found = flicker(path_errors(bench, motion, part, variant, times_ms))
        row = _row(bench, motion, part, name, found, times_ms)
        print(_line(row), file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def _line(row: "SequenceRow") -> str:
    return (
        f"{row.case:<22}{row.setting:<20}{row.method:<22}{row.median_ms:7.1f} ms, "
        f"flicker {row.error:.1f} dB (frame {row.worst_frame}; median "
        f"{row.median_flicker_db:.1f} dB), pixels {row.pixel_999_ratio:.4f}, "
        f"popping x{row.popping_ratio:.1f}, jump x{row.jump_ratio:.1f} "
        f"(frame {row.jump_frame}), error {row.psnr_db:.1f} dB"
    )


def _row(bench, motion, part, name, found: Flicker, times_ms) -> SequenceRow:
    jumps = found.jumps()
    worst = int(found.step_rms.argmax())
    place = "whole frame" if bench.mode == "on-axis" else "two windows"
    return SequenceRow(
        bench="sequence",
        method=name,
        case=f"{bench.eye} {bench.mode}",
        setting=f"{motion}, {part[1] - part[0]} frames",
        n=len(times_ms),
        median_ms=float(np.median(times_ms)),
        p95_ms=float(np.percentile(times_ms, 95)),
        memory_mb=working_memory_mb(bench.renderer),
        error_name="flicker_db",
        error=found.flicker_db,
        reference=f"dense, {place}",
        psnr_db=found.error_db,
        median_flicker_db=decibels(float(np.median(found.step_rms))),
        pixel_999_ratio=float(found.step_999.max()),
        popping_ratio=found.popping_ratio,
        jump_ratio=float(jumps.max()),
        worst_frame=part[0] + worst + 1,
        jump_frame=part[0] + int(jumps.argmax()) + 1,
        flicker_db=[decibels(float(step)) for step in found.step_rms],
    )


def plot(rows: list[SequenceRow], file: Path) -> None:
    """Flicker along each path, a panel for each motion and mode."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    panels = list(dict.fromkeys((row.case, row.setting) for row in rows))
    figure, axes = pyplot.subplots(
        len(panels), 1, figsize=(10, 2.5 * len(panels)), layout="constrained"
    )
    for panel, (case, setting) in zip(np.ravel(axes), panels, strict=True):
        for row in rows:
            if (row.case, row.setting) == (case, setting):
                shown_db = np.minimum(row.flicker_db, STILL_DB)
                panel.plot(shown_db, label=row.method)
        panel.set(title=f"{case}, {setting}", ylabel="flicker, dB below white")
        panel.grid(alpha=0.3)
    np.ravel(axes)[0].legend(fontsize="x-small")
    figure.savefig(file, dpi=100)
    pyplot.close(figure)


def main() -> None:
    """Run, print, and write tests/benchmarks/results/sequence.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="six frames a path")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", action="store_true", help="results/sequence.png")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=MOTIONS)
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--methods", nargs="+", choices=VARIANTS)
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    arguments = parser.parse_args()
    new_renderer = renderer_maker(arguments.engine)
    part = QUICK_FRAMES if arguments.quick else (0, FRAME_COUNT)
    rows, notes, benches = [], [], {}
    for mode in arguments.modes:
        for motion in arguments.motions:
            if motion == "gaze" and mode == "on-axis":
                continue
            eyes = FOCUSING_EYES if motion == "focus" else EYES
            bench = benches.setdefault(
                (mode, eyes[mode]), SequenceBench(new_renderer, mode, eyes[mode])
            )
            rows += bench_motion(bench, motion, part, arguments.methods)
    content = report(rows, machine={**machine_info(), "renderer": new_renderer().name})
    content["notes"] = notes
    if arguments.json:
        print(json.dumps(content))
    else:
        print(*map(_line, rows), sep="\n")
    is_whole = (arguments.motions, arguments.modes) == (MOTIONS, MODES)
    is_whole = is_whole and not (arguments.quick or arguments.methods)
    if arguments.plot:
        plot(rows, (RESULTS if is_whole else OUT) / "sequence.png")
    if is_whole:
        write_report("sequence", content)


if __name__ == "__main__":
    main()
