"""Plans that follow a stream, against all that its settings allow.

    python -m tests.benchmarks.bench_follow [--quick] [--json]

Two streams of ten seconds go through `EyeFilter` in real time: the demo's walk, and one
whose pupil and focus sweep from 2 to 7 mm and from 0 to 6 dpt.  A row says how many
PSFs the largest store has and all of them together, when the first picture and the
first whole eye were there, the slowest frame, and how many frames were seen through
less than the whole.  Errors: of a frame in the middle of the walk against the dense
reference, for both ways; and of what changes in a frame when one store takes the place
of another, as encoded for a screen, beside what a pupil 0.1 mm wider changes in the
same frames: less than a breath does.  Writes results/follow.json.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.profiles.parse import parse_profile
from filter_service.building.from_profile import build
from filter_service.building.jobs import BuildJob
from filter_service.building.limits import BuildLimits
from filter_service.building.used_ranges import UsedRanges
from filter_service.building.worker_handle import WorkerHandle
from filter_service.filtering.accepted_profile import PreparedStore
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.filtered import EyeReady
from filter_service.filtering.workshop import Workshop
from filter_service.rendering.native.renderer import NativeRenderer
from filter_service.settings import FilterSettings
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.benchmarks.live_walk import Judge, Walk

EYES = ("emmetropia", "myopia", "keratoconus")
CASES = (((480, 270), EYES), ((1280, 720), EYES[:1]))
STREAM_S, FRAMES_PER_S = 10.0, 12.0
COUNT = 48
PUPIL_STEP_MM = 0.1
REFERENCE = "dense reference; the store before"
LIMITS = BuildLimits(psf_engine="cpu")

State = dict[str, float]


def sweeping(share: float) -> State:
    """State of a stream that asks for everything in turn."""
    return {"pupil_diameter_mm": 2.0 + 5.0 * share, "focus_dpt": 6.0 * share}


def walking(walk: Walk) -> Callable[[float], State]:
    """State of the demo's walk at a share of its way."""
    return lambda share: walk.states[int(share * len(walk.states))]


@dataclass
class Seen:
    """What came of one stream."""

    first_s: float = 0.0
    whole_s: float = 0.0
    psf_counts: list[int] = field(default_factory=list)
    switches: list[tuple[float, UsedRanges | None]] = field(default_factory=list)
    times_ms: list[float] = field(default_factory=list)
    incomplete_count: int = 0


def _psf_count(prepared: PreparedStore) -> int:
    return int(prepared.store.store.psf_count)  # type: ignore[attr-defined]


def streamed(
    eye: str, walk: Walk, state_at: Callable[[float], State], prepare: str
) -> Seen:
    """Send a stream through an eye in real time; nothing is known of it before."""
    seen, ready = Seen(), []
    started_s = time.monotonic()

    def note(event) -> None:
        if isinstance(event, EyeReady):
            ready.append((time.monotonic() - started_s, event.is_complete))

    renderer = NativeRenderer()
    workshop = Workshop(WorkerHandle(), renderer, LIMITS, engine_name="native")
    settings, camera = FilterSettings(prepare=prepare), walk.views[0].camera
    try:
        with EyeFilter(
            {"kind": "preset", "name": eye},
            camera,
            settings,
            on_event=note,
            workshop=workshop,
        ) as eye_filter:
            first = walk.views[0]
            eye_filter.filter(first, **state_at(0.0))
            seen.first_s = time.monotonic() - started_s
            eye_filter.wait()
            seen.whole_s = ready[-1][0]
            _send(eye_filter, walk, state_at, seen)
    finally:
        workshop.close()
    return seen


def _send(eye_filter: EyeFilter, walk: Walk, state_at, seen: Seen) -> None:
    last, started_s = None, time.monotonic()
    count = int(STREAM_S * FRAMES_PER_S)
    for number in range(count):
        while time.monotonic() < started_s + number / FRAMES_PER_S:
            eye_filter.advance()
            time.sleep(0.001)
        eye_filter.advance()  # a stream that is late has no time to wait
        share = number / count
        view = walk.views[int(share * len(walk.views))]
        before_s = time.perf_counter()
        frame = eye_filter.try_filter([view], **state_at(share))
        assert frame is not None  # the eye is whole: it never waits
        seen.times_ms.append(1e3 * (time.perf_counter() - before_s))
        seen.incomplete_count += not frame.is_complete
        prepared = eye_filter.prepared_stores[-1]
        if prepared is not last:
            last = prepared
            seen.psf_counts.append(_psf_count(prepared))
            if prepared.is_complete:
                seen.switches.append((share, prepared.ranges))


@dataclass
class Steps:
    """Changes of frames, PSNR of the encoded picture, one for each change of store."""

    store_db: list[float] = field(default_factory=list)
    pupil_db: list[float] = field(default_factory=list)
    p99_codes: list[float] = field(default_factory=list)

    @property
    def words(self) -> str:
        """Say which change 1 % of the pixels exceed at worst."""
        if not self.p99_codes:
            return ""
        return f"; 99 % change by {max(self.p99_codes):.0f} of 255"

    def worst_db(self, name: str) -> float:
        """Return the largest change; not a number where there is none."""
        return min(getattr(self, name), default=float("nan"))


def steps_of(eye: str, walk: Walk, state_at, seen: Seen) -> Steps:
    """Compare the pictures of two stores where one takes the place of the other."""
    renderer, steps = NativeRenderer(), Steps()
    whole = renderer.load(_built(eye, walk, None))
    for (_, before), (share, after) in zip(
        seen.switches, seen.switches[1:], strict=False
    ):
        state, view = state_at(share), walk.views[int(share * len(walk.views))]
        now = UsedRanges(
            (state["pupil_diameter_mm"],) * 2, (state["focus_dpt"],) * 2, (0.0, 0.0)
        )
        if before is None or not replace(before, object_dpt=(0.0, 20.0)).holds(now):
            continue  # what came before was not for this state: the preview bridged it
        wider = state | {
            "pupil_diameter_mm": state["pupil_diameter_mm"] + PUPIL_STEP_MM
        }
        first, second = (renderer.load(_built(eye, walk, r)) for r in (before, after))
        old, new, narrow, wide = (
            renderer.render(view, handle, **own, output="srgb8").color / 255.0
            for handle, own in (
                *((first, state), (second, state)),
                *((whole, state), (whole, wider)),
            )
        )
        steps.store_db.append(_psnr_db(new - old))
        steps.pupil_db.append(_psnr_db(wide - narrow))
        steps.p99_codes.append(float(np.percentile(255.0 * np.abs(new - old), 99)))
    return steps


def _psnr_db(difference: NDArray[np.float64]) -> float:
    return -10.0 * math.log10(max(float(np.mean(difference**2)), 1e-12))


def _built(eye: str, walk: Walk, ranges: UsedRanges | None):
    job = BuildJob(
        profile=parse_profile({"kind": "preset", "name": eye}),
        settings=FilterSettings(prepare="stream" if ranges else "ranges"),
        camera=walk.views[0].camera,
        ranges=ranges,
        with_preview=False,
    )
    *_, built = build(job, progress=lambda *_: None, cancelled=lambda: False)
    return built.store


def error_db(eye: str, walk: Walk, ranges: UsedRanges | None) -> float:
    """PSNR, linear, of the walk's judged frame against the dense reference."""
    judge = Judge.of(walk, eye, compute=True)
    renderer = NativeRenderer()
    handle = renderer.load(_built(eye, walk, ranges))
    return judge.error_db(renderer, handle, 1.0)


def _rows(eye: str, size_px, walk: Walk, *, judged: bool) -> list[Row]:
    rows, case = [], f"{eye} {size_px[0]}"
    for name, state_at in (("walk", walking(walk)), ("sweep", sweeping)):
        for prepare in ("ranges", "stream"):
            seen = streamed(eye, walk, state_at, prepare)
            setting = (
                f"{max(seen.psf_counts)} PSFs at most, {sum(seen.psf_counts)} in all; "
                f"first picture {seen.first_s:.2f} s, whole {seen.whole_s:.2f} s; "
                f"slowest {max(seen.times_ms):.0f} ms; {seen.incomplete_count} of "
                f"{len(seen.times_ms)} frames not whole"
            )
            p95_ms = float(np.percentile(seen.times_ms, 95))
            median_ms = float(np.median(seen.times_ms))
            steps = Steps()
            if prepare == "stream":
                steps = steps_of(eye, walk, state_at, seen)
            rows.append(
                Row(
                    *("follow", f"{name}, {prepare}", case, setting + steps.words),
                    *(len(seen.psf_counts), median_ms, p95_ms, memory_mb()),
                    *("change of store, dB", steps.worst_db("store_db"), REFERENCE),
                )
            )
            if steps.store_db:
                rows.append(
                    replace(
                        rows[-1],
                        error_name="pupil 0.1 mm wider, dB",
                        error=steps.worst_db("pupil_db"),
                    )
                )
            if judged and name == "walk":
                middle = next(
                    (r for share, r in reversed(seen.switches) if share <= 0.5), None
                )
                rows.append(
                    replace(
                        rows[-1],
                        error_name="middle frame, dB",
                        error=error_db(eye, walk, middle),
                    )
                )
    return rows


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye, one size")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    rows = []
    cases = ((CASES[0][0], EYES[:1]),) if options.quick else CASES
    for size_px, eyes in cases:
        walk = Walk.of(size_px, COUNT)
        for eye in eyes:
            rows += _rows(eye, size_px, walk, judged=size_px == CASES[0][0])
    publish("follow", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
