"""Processor time of a frame of the OpenGL engine, with all passes disabled.

    python -m tests.benchmarks.bench_host [--quick] [--json]

Frames are filtered once, without the splat, from which no other pass reads; then every
dispatch gets no work groups, while all else runs as it is: checks, plans, copies to and
from the driver, calls of it.  What the passes had written stays.  The shaders' variants
and mapped memory are a hardware GPU's, whatever the driver.

- ``all``: the frame;
- ``image copies``: between the caller's arrays and the driver's memory, GB/s beside it;
- ``driver's copies``: between its buffers, barriers and waits, which a GPU does by
  itself.  A software driver copies on this processor, which would empty its caches, so
  it is told to copy four bytes of each image;
- ``rest``: Python, numpy, compiled loops and calls of OpenGL.

Frames of arrays, and, with "textures" in their setting, frames from textures to
textures of the caller's context, which copy no image and wait for nothing.

"frozen": pupil and focus stay; "moving": they change with every frame.  The error is
that of a real frame against the native engine, PSNR in linear light.  Every case has
its numbers of dispatches, bindings, uniforms, copies and waits of a frame.  Minima are
listed beside medians, which other processes on a core increase.

Writes results/host.json.
"""

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

import moderngl
import numpy as np

from filter_service.gl import gpu as gpu_module
from filter_service.gl.gpu import Gpu
from filter_service.gl.staging import Staging
from filter_service.rendering.gl.list_passes import ListPasses
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.gpu_cases import (
    FOCUS_DPT,
    PUPIL_MM,
    QUICK_VIEWS,
    REFERENCE,
    VIEWS,
    Case,
    TextureCase,
    open_case,
)
from tests.benchmarks.harness import Row, publish

SETTINGS = ("1280x720", "2 x 1832x1920")
EYES, QUICK_EYES = ("-6 dpt", "emmetropia"), ("emmetropia",)
STATES = 4
FRAMES, WARM_FRAMES = 200, 30
DRIVERS = ("driver's copies", "barriers", "fences", "waits")
IMAGE_BYTES = 1 << 18
"""Copies of the driver's from here on are of images; smaller ones are needed."""
PARTS = ("all", "image copies", "driver's copies", "rest")


def hardware_like() -> Gpu:
    """Return the context, used as a hardware GPU's is."""
    gpu = Gpu()
    gpu.is_software = False
    gpu.use_staging(True)
    return gpu


class Clock:
    """Times of named parts of a frame, ms, and how often things happened."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin a frame."""
        self.times_ms: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.copied_bytes = 0

    def timed(self, part: str, function):
        """Return a function whose time is added to a part."""

        def call(*arguments, **options):
            start_s = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.times_ms[part] += 1e3 * (time.perf_counter() - start_s)
                self.counts[part] += 1

        return call

    def counted(self, name: str, function):
        """Return a function whose calls are counted."""

        def call(*arguments, **options):
            self.counts[name] += 1
            return function(*arguments, **options)

        return call


@contextmanager
def empty_passes(clock: Clock) -> Iterator[None]:
    """Within, dispatches have no groups; copies are timed, calls are counted."""

    def run(shader, *_groups):
        clock.counts["dispatches"] += 1
        shader.mglo.run(0, 0, 0)

    driver_copy, image_copy = Staging._copy, gpu_module.copy_bytes

    def few_bytes(staging, source, target, read_at, write_at, n_bytes):
        if n_bytes >= IMAGE_BYTES:
            n_bytes = 4
        driver_copy(staging, source, target, read_at, write_at, n_bytes)

    def copy(target, source):
        clock.copied_bytes += source.size
        image_copy(target, source)

    compute = moderngl.ComputeShader
    buffer = moderngl.Buffer
    changes = [
        (compute, "run", run),
        (compute, "run_indirect", run),
        (gpu_module, "copy_bytes", clock.timed("image copies", copy)),
        (Staging, "_copy", clock.timed("driver's copies", few_bytes)),
        (Staging, "fence", clock.timed("fences", Staging.fence)),
        (Staging, "wait", clock.timed("waits", Staging.wait)),
        (moderngl.VertexArray, "render", lambda *_, **__: None),
        (
            moderngl.Context,
            "memory_barrier",
            clock.timed("barriers", moderngl.Context.memory_barrier),
        ),
        (
            buffer,
            "bind_to_storage_buffer",
            clock.counted("bindings", buffer.bind_to_storage_buffer),
        ),
        (
            moderngl.Uniform,
            "value",
            moderngl.Uniform.value.setter(
                clock.counted("uniforms", moderngl.Uniform.value.fset)
            ),
        ),
    ]
    with ExitStack() as stack:
        for where, name, what in changes:
            stack.enter_context(patch.object(where, name, what))
        yield


def case_rows(case: Case | TextureCase, is_moving: bool, count: int) -> Iterator[Row]:
    """Times of an eye's frames on nothing."""
    spec = case.handles[0].store.spec
    states = states_towards(spec, PUPIL_MM, FOCUS_DPT, STATES if is_moving else 1)
    clock, frames = Clock(), []
    with patch.object(ListPasses, "_splat", lambda *_, **__: None):
        for state in (*states, states[0], states[0]):
            case.frame(state)
    with empty_passes(clock):
        for k in range(WARM_FRAMES + count):
            clock.clear()
            total_ms, stages_ms = case.frame(states[k % len(states)])
            if k >= WARM_FRAMES:
                frames.append((total_ms, clock.times_ms, stages_ms))
    yield from _rows(case, is_moving, frames, clock)


def _rows(
    case: Case | TextureCase, is_moving: bool, frames: list, clock: Clock
) -> Iterator[Row]:
    told = ", ".join(
        f"{clock.counts[name]} {said}"
        for name, said in (
            ("dispatches", "dispatches"),
            ("bindings", "bindings"),
            ("uniforms", "uniforms"),
            ("driver's copies", "copies"),
            ("waits", "waits"),
        )
    )
    times_ms = {name: [] for name in PARTS}
    for total_ms, parts_ms, _ in frames:
        copies_ms = parts_ms["image copies"]
        driver_ms = sum(
            parts_ms[name]
            for name in ("driver's copies", "barriers", "fences", "waits")
        )
        values = (total_ms, copies_ms, driver_ms, total_ms - copies_ms - driver_ms)
        for name, value in zip(PARTS, values, strict=True):
            times_ms[name].append(value)
    copies_ms = max(float(np.median(times_ms["image copies"])), 1e-6)
    gigabytes_s = clock.copied_bytes / 1e6 / copies_ms
    said = {"all": told, "image copies": f"{gigabytes_s:.1f} GB/s"}
    said["rest"] = f"least {np.min(times_ms['rest']):.2f} ms"
    plans_ms = [stages_ms.get("psf_plan_ms", 0.0) for *_, stages_ms in frames]
    times_ms["plans of it"] = plans_ms
    for name, values in times_ms.items():
        setting = f"{case.setting} {'moving' if is_moving else 'frozen'}"
        yield Row(
            bench="host",
            method=name,
            case=case.eye,
            setting=f"{setting}; {said[name]}" if name in said else setting,
            n=len(values),
            median_ms=float(np.median(values)),
            p95_ms=float(np.percentile(values, 95)),
            memory_mb=case.memory_mb,
            error_name="psnr_db",
            error=case.error_db,
            reference=REFERENCE,
        )


def main() -> None:
    """Run, print, and write tests/benchmarks/results/host.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small frames, few")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    gpu, rows = hardware_like(), []
    views = QUICK_VIEWS if options.quick else {name: VIEWS[name] for name in SETTINGS}
    for setting, (size_px, view_count) in views.items():
        for eye in QUICK_EYES if options.quick else EYES:
            case = open_case(gpu, eye, setting, size_px, view_count)
            count = 20 if options.quick else FRAMES
            context = moderngl.create_context(
                standalone=True, backend="egl", require=430
            )
            with context:
                textures = TextureCase(case, is_software=False)
                for is_moving in (False, True):
                    rows += case_rows(textures, is_moving, count)
                textures.release()
            context.release()
            for is_moving in (False, True):
                rows += case_rows(case, is_moving, count)
            case.release()
    publish("host", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
