"""Every method against the dense reference: work, memory and four error measures.

    python -m tests.benchmarks.bench_field [--quick] [--json] [--plot] [--resume]
        [--images DIR] [--eyes NAME ...] [--sizes WxH ...] [--scenes NAME ...]
        [--methods TEXT ...]

Six eyes, two scenes and all methods at 640x360, *Courtyard* alone at 320x180; at
1280x720 the renderer on the axis for all of them, where the reference is quick, and all
methods for two eyes.  An eye and a scene at 640x360 take 170 s of processor time, most
of it for references and caches.

The reference of methods on the axis has the PSF of the axis everywhere; that of the
others follows the visual field.  Methods that take any pupil and focus are also
measured at random ones, others for each eye, scene and size, so nearly always between
nodes.  Time is that of a frame whose pupil and focus are not those of the frame before,
so that its kernels are made anew (`frame_runs`); rows named "frozen" repeat one state.
Methods that convolve are timed likewise, with the PSFs of the new state.  The paper's
layouts have counted PSF samples in place of a time: they are scatters without tiles or
merging, which would be another method's time.  Preparation for an eye stands beside it,
and so do the paper's figures, whose errors are of 8-bit images: beside ours of 8 bits.

References are kept under out/dense_references; rows are kept as they come, and
``--resume`` goes on where a run of the same commit was cut off.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.engines import ENGINES, open_renderer
from tests.benchmarks.field_methods import (
    FOCUS_RANGE_DPT,
    METHODS,
    PAPER_RANGES,
    QUALITY_WIDE,
    EyeBench,
    Method,
    State,
)
from tests.benchmarks.field_pictures import (
    pixels_of,
    plot_errors,
    write_differences,
)
from tests.benchmarks.harness import (
    OUT,
    RESULTS,
    Row,
    commit_id,
    machine_info,
    report,
    write_report,
)
from tests.benchmarks.image_measures import measures
from tests.benchmarks.published_figures import CONDITIONS, published
from tests.numerical.scene_frames import SCENES, scene_view

FIXED = State(5.0, 0.5)
SEED = 5

UNBINNED_PIXEL_COUNT = 60_000
"""Larger frames are compared with the binned reference over the field; on the axis all
are: there it has bins of distance alone, and is 50 times as quick."""

REPEATS = 3

TARGETS_DB = {
    "ours on-axis": 46.0,
    "ours on-axis wide": 46.0,
    "ours quality": 45.0,
    QUALITY_WIDE: 45.0,
    "ours dynamic": 44.0,
}
"""Linear PSNR that no row of a method may miss."""

KEPT = OUT / "field_rows.jsonl"


@dataclass(frozen=True)
class Part:
    """Which eyes, scenes and methods a size is measured for.

    Attributes
    ----------
    methods : tuple
        Names; all where it is empty.
    random_count : int
        Random states of each eye and scene.
    """

    size: tuple[int, int]
    eyes: tuple[str, ...] = CONDITIONS
    scenes: tuple[str, ...] = SCENES
    methods: tuple[str, ...] = ()
    random_count: int = 1

    @property
    def name(self) -> str:
        """Size in words."""
        return f"{self.size[0]}x{self.size[1]}"


ON_AXIS_NAMES = tuple(m.name for m in METHODS if m.name.startswith("ours on-axis"))
ALL_BUT_WIDE = tuple(m.name for m in METHODS if not m.name.startswith(QUALITY_WIDE))
"""The quality mode for all pupils and foci is for smaller frames: at 1280x720 it takes
minutes to build."""

PARTS = (
    Part((320, 180), scenes=SCENES[:1]),
    Part((640, 360)),
    Part((1280, 720), methods=ON_AXIS_NAMES),
    Part((1280, 720), ("myopia", "keratoconus"), SCENES[:1], ALL_BUT_WIDE, 0),
)
QUICK_PARTS = (Part((192, 108), ("keratoconus",), SCENES[:1]),)


@dataclass(frozen=True)
class FieldRow(Row):
    """A row with the other measures of its image.

    Attributes
    ----------
    scene, size : str
    psnr_srgb8_db, ssim_ratio, mean_delta_e : float
        See `image_measures.Measures`; ``error`` is the linear PSNR.
    prepare_ms : float
        PSFs of the eye, once.
    n : int
        Timed frames; 0 where there is no time.
    median_ms, p95_ms : float or None
    psf_count : int
    tap_count : int or None
        PSF samples that the frame needs, where they are counted: those within the
        square or box of a PSF.  Tiles evaluate more, theirs as ours.
    published : dict or None
        The paper's figures for this method, condition and scene, and their hardware.
    """

    scene: str
    size: str
    median_ms: float | None
    p95_ms: float | None
    psnr_srgb8_db: float
    ssim_ratio: float
    mean_delta_e: float
    prepare_ms: float
    psf_count: int
    tap_count: int | None
    published: dict | None


class KeptRows:
    """Rows of this commit and machine, in a file from the first on.

    Parameters
    ----------
    resumes : bool
        Whether rows that are there already count; otherwise the file starts empty.
    """

    def __init__(self, path: Path, origin: str, *, resumes: bool):
        self._path, self._origin = path, origin
        self._rows: dict[str, FieldRow] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if not resumes:
            path.write_text("", encoding="utf-8")
            return
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        for line in lines:
            content = json.loads(line)
            if content["origin"] == origin:
                self._rows[content["key"]] = FieldRow(**content["row"])

    def get(self, key: str) -> FieldRow | None:
        """Return the row of a key."""
        return self._rows.get(key)

    def add(self, key: str, row: FieldRow) -> None:
        """Write a row at once."""
        self._rows[key] = row
        line = json.dumps({"origin": self._origin, "key": key, "row": asdict(row)})
        with self._path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def random_states(eye: str, scene: str, size: str, count: int) -> list[State]:
    """Pupils and foci within all methods' ranges; others for each eye, scene, size."""
    seed = [SEED, *f"{eye} {scene} {size}".encode()]
    rng = np.random.default_rng(seed)
    low_dpt = PAPER_RANGES["focus_range_dpt"][0]
    return [
        State(
            float(rng.uniform(*PAPER_RANGES["pupil_range_mm"])),
            float(rng.uniform(low_dpt, FOCUS_RANGE_DPT[1])),
        )
        for _ in range(count)
    ]


def bench_eye(
    renderer, eye: str, part: Part, methods, kept: KeptRows, images
) -> list[Row]:
    """Rows of one eye and image size."""
    width_px, height_px = part.size
    views = {
        scene: scene_view(scene, width_px=width_px, height_px=height_px)
        for scene in part.scenes
    }
    bench = EyeBench(renderer, eye, list(views.values()))
    rows = []
    for method in methods:
        for scene, view in views.items():
            others = random_states(eye, scene, part.name, part.random_count)
            for state in method.states(FIXED, others):
                key = f"{eye} {scene} {part.name} {state} {method.name}"
                row = kept.get(key)
                if row is None:
                    found = _measured(bench, view, method, state)
                    row = _row(found, eye, scene, part.name, method, state)
                    kept.add(key, row)
                    if images:
                        write_differences(images, key, found.color, found.reference)
                    print(_line(row), file=sys.stderr, flush=True)
                rows.append(row)
    bench.release()
    return rows


@dataclass(frozen=True)
class _Found:
    results: list
    reference: np.ndarray
    reference_name: str

    @property
    def color(self) -> np.ndarray:
        return self.results[-1].color


def _measured(bench: EyeBench, view, method: Method, state: State) -> _Found:
    is_large = view.width_px * view.height_px > UNBINNED_PIXEL_COUNT
    bins = method.on_axis or is_large
    exact = bench.exact_state(state, on_axis=method.on_axis)
    place = "on the axis" if method.on_axis else "over the field"
    psfs = "PSF of every pixel"
    if bins:
        psfs = "bins of " + "0.2 deg and " * (not method.on_axis) + "0.005 dpt"
    return _Found(
        results=method.run(bench, view, state, REPEATS),
        reference=dense_reference(view, exact, bins=bins),
        reference_name=f"dense, {place}, {psfs}",
    )


def _row(found: _Found, eye, scene, size, method: Method, state: State) -> FieldRow:
    last = found.results[-1]
    errors = measures(last.color, found.reference)
    times_ms = [result.render_ms for result in found.results if method.timed]
    theirs = published(method.published_name, eye, scene)
    return FieldRow(
        bench="field",
        method=method.name,
        case=eye,
        setting=f"{scene} {size} {state}",
        n=len(times_ms),
        median_ms=float(np.median(times_ms)) if times_ms else None,
        p95_ms=float(np.percentile(times_ms, 95)) if times_ms else None,
        memory_mb=last.memory_mb,
        error_name="psnr_db",
        error=errors.psnr_db,
        reference=found.reference_name,
        scene=scene,
        size=size,
        psnr_srgb8_db=errors.psnr_srgb8_db,
        ssim_ratio=errors.ssim_ratio,
        mean_delta_e=errors.mean_delta_e,
        prepare_ms=last.prepare_ms,
        psf_count=last.psf_count,
        tap_count=last.tap_count or None,
        published=None if theirs is None else asdict(theirs),
    )


HEADER = (
    f"{'eye':<12}{'scene, size, pupil, focus':<38}{'method':<25}{'ms':>8}{'/px':>7}"
    f"{'dB':>6}{'8 bit':>6}{'SSIM':>8}{'dE':>6}{'MB':>8}{'prepare':>9}  published"
)


def _line(row: FieldRow) -> str:
    theirs = ""
    if row.published is not None:
        theirs = (
            "{psnr_srgb8_db} dB of 8 bits, {median_ms:g} ms, {scene}, {hardware}"
        ).format(**row.published)
    time = "" if row.median_ms is None else f"{row.median_ms:.1f}"
    taps = "" if row.tap_count is None else f"{row.tap_count / pixels_of(row.size):.1f}"
    return (
        f"{row.case:<12}{row.setting:<38}{row.method:<25}{time:>8}{taps:>7}"
        f"{row.error:6.1f}{row.psnr_srgb8_db:6.1f}{row.ssim_ratio:8.4f}"
        f"{row.mean_delta_e:6.2f}{row.memory_mb:8.1f}{row.prepare_ms:9.0f}  {theirs}"
    )


def target_rows(rows: list[FieldRow]) -> list[dict]:
    """For each method with a target its worst row, size by size."""
    found = []
    for method, size in dict.fromkeys((row.method, row.size) for row in rows):
        own = [row for row in rows if (row.method, row.size) == (method, size)]
        if method not in TARGETS_DB:
            continue
        worst = min(own, key=lambda row: row.error)
        found.append(
            {
                "method": method,
                "size": size,
                "target_db": TARGETS_DB[method],
                "worst_db": worst.error,
                "median_db": float(np.median([row.error for row in own])),
                "worst": f"{worst.case} {worst.setting}",
                "below": sum(row.error < TARGETS_DB[method] for row in own),
                "n": len(own),
            }
        )
    return found


def print_targets(found: list[dict]) -> None:
    """One line for each method and size."""
    for line in found:
        print(
            "{method:<19}{size:<10}{worst_db:5.1f} dB at worst ({worst}), median "
            "{median_db:.1f} dB; {below} of {n} below {target_db:g} dB".format(**line)
        )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="192x108, one eye")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", action="store_true", help="results/field.png")
    parser.add_argument("--resume", action="store_true", help="keep rows of a run")
    parser.add_argument("--images", type=Path, metavar="DIR", help="write differences")
    parser.add_argument("--eyes", nargs="+", choices=CONDITIONS, default=CONDITIONS)
    parser.add_argument("--sizes", nargs="+", metavar="WxH")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument(
        "--methods", nargs="+", help="only methods with such a text in their name"
    )
    return parser.parse_args()


def _parts(arguments: argparse.Namespace) -> list[Part]:
    """What is left to measure after --quick, --sizes, --eyes and --scenes."""
    parts = []
    for part in QUICK_PARTS if arguments.quick else PARTS:
        eyes = tuple(eye for eye in part.eyes if eye in arguments.eyes)
        scenes = tuple(name for name in part.scenes if name in arguments.scenes)
        wanted = not arguments.sizes or part.name in arguments.sizes
        if eyes and scenes and wanted:
            parts.append(replace(part, eyes=eyes, scenes=scenes))
    return parts


def _methods(part: Part, texts: list[str] | None) -> list[Method]:
    return [
        method
        for method in METHODS
        if (not part.methods or method.name in part.methods)
        and (not texts or any(text in method.name for text in texts))
    ]


def run(renderer, arguments: argparse.Namespace, origin: str) -> list[FieldRow]:
    """Measure all parts; a row that two of them have counts once."""
    kept = KeptRows(KEPT, origin, resumes=arguments.resume)
    parts = _parts(arguments)
    rows = {}
    for part in parts:
        methods = _methods(part, arguments.methods)
        for eye in part.eyes:
            for row in bench_eye(renderer, eye, part, methods, kept, arguments.images):
                rows[row.case, row.setting, row.method] = row
    return list(rows.values())


def main() -> None:
    """Run, print, and write tests/benchmarks/results/field.json."""
    arguments = _arguments()
    renderer = open_renderer(arguments.engine)
    machine = {**machine_info(), "renderer": renderer.name}
    origin = f"{commit_id()} {machine['cpu']} {machine['renderer']}"
    rows = run(renderer, arguments, origin)
    targets = target_rows(rows)
    content = {**report(rows, machine=machine), "targets": targets}
    if arguments.json:
        print(json.dumps(content))
    else:
        print(HEADER, *map(_line, rows), sep="\n")
        print_targets(targets)
    is_whole = _parts(arguments) == list(PARTS) and not arguments.methods
    if arguments.plot:
        plot_errors(rows, (RESULTS if is_whole else OUT) / "field.png")
    if is_whole:
        write_report("field", content)


if __name__ == "__main__":
    main()
