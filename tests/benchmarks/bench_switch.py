"""Time from a new profile to the first frame through the new eye.

Usage: python -m tests.benchmarks.bench_switch [--quick] [--json] [--mode MODE]
    [--eyes NAME ...]

A real service in a process of its own, frames of the courtyard streamed to it all the
time, one after the other; the eyes, pupils, foci and size of `ocufilter demo`.

Error: PSNR in linear light against the frame through PSFs at tolerance "fine" for just
this pupil and focus; for the stream the longest gap between two results while the eye
was built, over the median time of a frame just before.
"""

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.pyrender_stream import path_settings
from clients.service_process import ServiceProcess
from filter_service.messages import Dropped, ErrorReply, Ready
from tests.benchmarks.harness import (
    Row,
    machine_info,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.published_figures import CONDITIONS
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db

REFERENCE = 'the same frame, tolerance "fine", this pupil and focus only'
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5, "output": "linear"}
EYES = {name: {"kind": "preset", "name": name} for name in CONDITIONS[1:]}
START = {"kind": "preset", "name": "emmetropia"}
STEADY_FRAMES = 12
LIMIT_S = 120.0


@dataclass
class Switch:
    """One change of eye, seconds after its profile was sent."""

    first_s: float
    longest_gap_s: float
    steady_s: float
    first_color: np.ndarray
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...]


def switch(client: FilterClient, view: RgbdView, body: dict, settings: dict) -> Switch:
    """Send a profile into a running stream; go on until a frame shows the new eye."""
    steady = _Stream(client, view)
    while len(steady.frames) < STEADY_FRAMES:
        steady.turn()
    stream = _Stream(client, view)
    sent_s = time.monotonic()
    accepted = client.set_profile(body, settings=settings, wait=False)
    while not stream.shows(accepted.generation):
        if time.monotonic() > sent_s + LIMIT_S:
            raise RuntimeError(f"{body} was not ready within {LIMIT_S:g} s")
        stream.turn()
    first_s, first = stream.frames[-1]
    while not stream.ready or stream.frames[-1][0] == first_s:  # the next frame, too
        stream.turn()
    times_s = [t for t, _ in (steady.frames[-1], *stream.frames)]
    return Switch(
        first_s=first_s - sent_s,
        longest_gap_s=float(np.diff(times_s).max()),
        steady_s=float(np.median(np.diff([t for t, _ in steady.frames]))),
        first_color=first.color,
        psf_count=stream.ready[-1].psf_count,
        memory_mb=stream.ready[-1].memory_mb,
        notes=stream.ready[-1].notes,
    )


class _Stream:
    """Frames sent one after the other, and what came back when."""

    def __init__(self, client: FilterClient, view: RgbdView) -> None:
        self._client = client
        self._view = view
        self.frames: list[tuple[float, FilteredFrame]] = []
        self.ready: list[Ready] = []

    def turn(self) -> None:
        """Keep one frame on its way; note what has come back."""
        if self._client.n_unanswered == 0:
            self._client.submit(self._view, **STATE)
        for event in self._client.poll(1.0):
            if isinstance(event, ErrorReply):
                raise event.exception()
            if isinstance(event, Dropped):
                raise RuntimeError(f"a frame was dropped: {event.reason}")
            if isinstance(event, FilteredFrame):
                self.frames.append((time.monotonic(), event))
            elif isinstance(event, Ready):
                self.ready.append(event)

    def shows(self, generation: int) -> bool:
        """Return whether the last frame went through an eye."""
        return bool(self.frames) and self.frames[-1][1].generation == generation


def rows_of(
    name: str, setting: str, found: list[Switch], truth: np.ndarray | None
) -> list[Row]:
    """Rows of one eye: the first frame, and the stream meanwhile."""

    def row(method, times_s, error_name, error) -> Row:
        return Row(
            bench="switch",
            method=method,
            case=name,
            setting=setting,
            n=len(found),
            median_ms=1e3 * float(np.median(times_s)),
            p95_ms=1e3 * float(np.percentile(times_s, 95)),
            memory_mb=found[-1].memory_mb,
            error_name=error_name,
            error=error,
            reference=REFERENCE if error_name == "psnr_db" else "steady stream",
        )

    gaps = [s.longest_gap_s for s in found]
    gap_ratio = max(s.longest_gap_s / s.steady_s for s in found)
    error = ("gap_frames", gap_ratio)
    if truth is not None:
        error = ("psnr_db", min(psnr_db(s.first_color, truth) for s in found))
    return [
        row("first frame", [s.first_s for s in found], *error),
        row("longest gap", gaps, "gap_frames", gap_ratio),
    ]


def people(count: int) -> list[dict]:
    """Return profiles of random people; most are nearly emmetropic, as people are."""
    rng = np.random.default_rng(36)
    return [
        {
            "kind": "prescription",
            "eye_side": str(rng.choice(["OD", "OS"])),
            "sphere_dpt": round(float(np.clip(rng.normal(-1.0, 2.5), -9, 6)) * 4) / 4,
            "cylinder_dpt": -round(float(min(rng.exponential(0.6), 4.0)) * 4) / 4,
            "axis_deg": float(rng.integers(0, 180)),
            "age_years": float(rng.integers(18, 76)),
        }
        for _ in range(count)
    ]


def true_frame(client: FilterClient, view: RgbdView, body: dict, settings: dict):
    """Return the frame through PSFs that nothing was saved on."""
    pupil_mm, focus_dpt = STATE["pupil_diameter_mm"], STATE["focus_dpt"]
    fine = settings | {
        "pupil_range_mm": (pupil_mm, pupil_mm),
        "focus_range_dpt": (focus_dpt, focus_dpt),
        "tolerance": "fine",
    }
    client.set_profile(body, settings=fine, views=[view], timeout_s=LIMIT_S)
    return client.filter(view, **STATE, timeout_s=60.0).color


def measure(
    view: RgbdView, settings: dict, eyes: list[str], repeats: int, n_people: int
) -> list[Row]:
    """Rows of all eyes: built, then from the disk, then after a restart."""
    rows: list[Row] = []
    size = f"{view.camera.width_px}x{view.camera.height_px} {settings['mode']}"
    with tempfile.TemporaryDirectory() as folder:
        cached = {"store_cache_dir": folder}
        with ServiceProcess({"store_cache_dir": ""}) as service:
            with FilterClient(service.endpoint) as client:
                truths = {
                    name: true_frame(client, view, EYES[name], settings)
                    for name in eyes
                }
                client.set_profile(START, settings=settings, views=[view])
                for name in eyes:
                    found = [
                        switch(client, view, EYES[name], settings)
                        for _ in range(repeats)
                    ]
                    rows += rows_of(name, size, found, truths[name])
                if n_people:
                    found = [
                        switch(client, view, body, settings)
                        for body in people(n_people)
                    ]
                    rows += rows_of("random people", size, found, None)
        with (
            ServiceProcess(cached) as service,
            FilterClient(service.endpoint) as client,
        ):
            client.set_profile(START, settings=settings, views=[view])
            for name in eyes:
                kept = len(list(Path(folder).glob("*.psfs")))
                switch(client, view, EYES[name], settings)
                _await_file(folder, kept + 1)
            for name in eyes:
                found = [
                    switch(client, view, EYES[name], settings) for _ in range(repeats)
                ]
                assert all("eye from the disk cache" in s.notes for s in found)
                rows += rows_of(name, f"{size}, from disk", found, truths[name])
        name = eyes[0]
        starts_s = [restart_s(cached, view, settings, name) for _ in range(repeats)]
        rows.append(
            Row(
                bench="switch",
                method="first frame",
                case=name,
                setting=f"{size}, after restart",
                n=repeats,
                median_ms=1e3 * float(np.median(starts_s)),
                p95_ms=1e3 * float(np.percentile(starts_s, 95)),
                memory_mb=0.0,
                error_name="psnr_db",
                error=rows[-2].error,
                reference=REFERENCE,
            )
        )
    return rows


def _await_file(folder: str, count: int) -> None:
    """Wait until so many stores are on disk."""
    end_s = time.monotonic() + LIMIT_S
    while len(list(Path(folder).glob("*.psfs"))) < count:
        if time.monotonic() > end_s:
            raise RuntimeError("a store was not written")
        time.sleep(0.05)


def restart_s(cached: dict, view: RgbdView, settings: dict, name: str) -> float:
    """Time from a service that is ready to the first frame through a stored eye."""
    with ServiceProcess(cached) as service, FilterClient(service.endpoint) as client:
        start_s = time.monotonic()
        client.set_profile(EYES[name], settings=settings, views=[view], wait="first")
        client.filter(view, **STATE)
        return time.monotonic() - start_s


def main() -> None:
    """Run, print, and write tests/benchmarks/results/switch.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye, once")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--mode", default=None, help="instead of on-axis and dynamic: one mode"
    )
    parser.add_argument("--people", type=int, default=100, help="random people")
    parser.add_argument("--size", default="480x270", help="of the frames, px")
    parser.add_argument("--eyes", nargs="+", choices=EYES, default=list(EYES))
    arguments = parser.parse_args()
    width_px, height_px = (int(part) for part in arguments.size.split("x"))
    frame = scene_view("courtyard", width_px=width_px, height_px=height_px)
    view = RgbdView(frame.color, frame.depth_m, frame.tangents)
    eyes = arguments.eyes[:1] if arguments.quick else arguments.eyes
    modes = [arguments.mode] if arguments.mode else ["on-axis", "dynamic"]
    base = path_settings("courtyard", "primitives")
    rows = []
    for mode in modes:
        repeats = 1 if arguments.quick else 3
        n_people = 0 if mode == "on-axis" else arguments.people
        rows += measure(view, base | {"mode": mode}, eyes, repeats, n_people)
    content = report(rows, machine=machine_info())
    if arguments.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    if not arguments.quick and eyes == list(EYES):
        write_report("switch", content)


if __name__ == "__main__":
    main()
