"""Frame time by blur radius, resolution and number of kernels.

    python -m tests.benchmarks.bench_cost [--quick] [--json] [--plot]
        [--sweeps NAME ...]

An eye of -6 dpt with a pupil of 7 mm looks at infinity: its blur is 21 mrad, and the
camera's pixels are as large as the radius in px asks for.  Frames are a textured plane
at infinity and *Courtyard* with its own distances, each with and without merging.
Kernels are counted over layers (blur step) and over the field (cells).

Every row has the evaluations it took, counted fragment by fragment and tile by tile
(`splat_work`), how many of them lay within a kernel, and what merging adds as an error.
Laws are slopes of log time; the unit that a pass's time
follows most closely says what bounds it.
"""

import argparse
import json
import math
import sys
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.constants import TILE_SIZE_PX
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.benchmarks.cost_law import AGAINST, CostRow, bounds, laws
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.engines import counted_work, open_renderer, working_memory_mb
from tests.benchmarks.field_pictures import plot_costs
from tests.benchmarks.frame_runs import timed_frames
from tests.benchmarks.harness import (
    OUT,
    RESULTS,
    machine_info,
    report,
    write_report,
)
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.view_sources import EyeState, linear_color
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.numerical.scene_frames import scene_view
from tests.reference import render_passes as reference

SPHERE_DPT = -6.0
PUPIL_MM = 7.0
BLUR_MRAD = -SPHERE_DPT * PUPIL_MM / 2.0
STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": 0.0}

RADII_PX = (2, 4, 8, 16, 32, 64)
SIZE = (640, 360)
SIZES = ((320, 180), (640, 360), (1280, 720), (1920, 1080), (2560, 1440))
FIXED_RADIUS_PX = 8
VERTICAL_FOV_DEG = 50.0
BLUR_STEPS_PX = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
STEPS_RADIUS_PX = 16
LAYERS_NEARER = np.float32(4.0)
"""*Courtyard* this much nearer has blur from hardly any to `STEPS_RADIUS_PX`."""

FIELD_EYE, FIELD_PUPIL_MM, FIELD_FOCUS_DPT = "keratoconus", 5.0, 0.5
FIELD_MODES = ("on-axis", "dynamic", "quality")
QUICK = {"radii": (2, 4, 8), "size": (320, 180), "sizes": ((160, 90), (320, 180))}

SWEEPS = tuple(AGAINST)

BUDGET_MS = 1500.0
MAX_REPEATS = 7

MAX_EVALUATIONS = 5e9
"""More are not measured without merging: half a minute a frame on two cores."""

MERGING = {"unmerged": False, "merged": True}

SEED = 7
OCTAVES_PX = (2, 4, 8, 16, 32, 64)


def plane_view(width_px: int, height_px: int, pixel_mrad: float) -> RgbdView:
    """Plane at infinity whose picture has the spectrum of natural ones, 1 / f."""
    rng = np.random.default_rng(SEED)
    light = np.zeros((height_px, width_px, 3))
    for cell_px in OCTAVES_PX:
        grid = rng.normal(size=(height_px // cell_px + 2, width_px // cell_px + 2, 3))
        y, x = (
            (np.arange(n) / cell_px).astype(np.float32) for n in (height_px, width_px)
        )
        light += _bilinear(grid, y, x)
    light = 0.2 * np.exp(0.4 * light)
    srgb = srgb_from_linear(np.clip(light, 0.0, 1.0))
    depth_m = np.full((height_px, width_px), np.inf, np.float32)
    return RgbdView(srgb, depth_m, tangents(width_px, height_px, pixel_mrad), "radial")


def _bilinear(grid: NDArray, y: NDArray, x: NDArray) -> NDArray:
    row, column = y.astype(int), x.astype(int)
    down, right = (y - row)[:, None, None], (x - column)[None, :, None]
    upper = grid[row] * (1 - down) + grid[row + 1] * down
    return upper[:, column] * (1 - right) + upper[:, column + 1] * right


def tangents(width_px: int, height_px: int, pixel_mrad: float) -> tuple:
    """Edges of a camera with square pixels."""
    right, up = (n * pixel_mrad / 2000.0 for n in (width_px, height_px))
    return -right, right, up, -up


def courtyard_view(width_px: int, height_px: int, pixel_mrad: float) -> RgbdView:
    """*Courtyard*, with the camera's angles scaled but its distances kept."""
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    own = tangents(width_px, height_px, pixel_mrad)
    return replace(view, tangents=own, depth_kind="radial")


VIEWS = {"plane": plane_view, "courtyard": courtyard_view}


class CostBench:
    """One view before the eye of -6 dpt, on axis."""

    def __init__(self, renderer, view: RgbdView, **settings):
        self.renderer, self.view = renderer, view
        with np.errstate(divide="ignore"):
            nearest_dpt = float(np.nanmax(1.0 / view.depth_m))
        self.spec = grid_spec(
            width_px=view.width_px,
            height_px=view.height_px,
            tangents=view.tangents,
            pupil_range_mm=(PUPIL_MM, PUPIL_MM),
            focus_range_dpt=(0.0, 0.0),
            object_range_dpt=(0.0, math.ceil(4.0 * nearest_dpt + 1.0) / 4.0),
            **settings,
        )
        profile = parse_profile({"kind": "prescription", "sphere_dpt": SPHERE_DPT})
        self.eye = MeasuredWavefront.from_profile(profile)
        self.handle = renderer.load(build_psf_store(profile, self.spec))
        self.state = STATE

    def truth(self) -> NDArray[np.float64]:
        """Picture through exact PSFs: one convolution, or the dense reference."""
        at = EyeState(self.eye, self.spec, PUPIL_MM, 0.0)
        if np.isfinite(self.view.depth_m).any():
            return dense_reference(self.view, at, bins=True)
        psfs = at.exact_psfs(np.zeros(1), np.zeros(1), np.zeros(1))
        return _convolved(linear_color(self.view), [psf.kernel for psf in psfs])

    reference_name = "exact PSFs"


class FieldBench(CostBench):
    """*Courtyard* through a traced eye, on axis or over the visual field."""

    def __init__(self, renderer, size, mode: str):
        self.renderer = renderer
        up = math.tan(math.radians(VERTICAL_FOV_DEG / 2))
        self.view = courtyard_view(*size, 2000.0 * up / size[1])
        self.spec = grid_spec(
            width_px=size[0],
            height_px=size[1],
            tangents=self.view.tangents,
            pupil_range_mm=(FIELD_PUPIL_MM,) * 2,
            focus_range_dpt=(FIELD_FOCUS_DPT,) * 2,
            object_range_dpt=(0.0, 4.0),
            mode=mode,
        )
        store = build_psf_store(traced_eye(FIELD_EYE, self.spec), self.spec)
        self.handle = renderer.load(store)
        self.state = {
            "pupil_diameter_mm": FIELD_PUPIL_MM,
            "focus_dpt": FIELD_FOCUS_DPT,
        }

    def truth(self) -> NDArray[np.float64]:
        """Sorted gather with the same layers and cells."""
        store = self.handle.store
        return reference.gather(
            self.view, store, frame_layers(store, State(**self.state))
        )

    reference_name = "float64 sorted gather, same layers"


def _convolved(color: NDArray, kernels: list[NDArray]) -> NDArray[np.float64]:
    planes = []
    white = np.ones(color.shape[:2])
    for c, kernel in enumerate(kernels):
        lit, covered = (
            fftconvolve(image, kernel.astype(np.float64), mode="same")
            for image in (color[..., c], white)
        )
        planes.append(lit / covered)
    return np.stack(planes, axis=-1)


def bench(case: CostBench, sweep: str, name: str, radius_px: float) -> list[CostRow]:
    """Rows of one frame, unmerged (unless that takes too long) and merged."""
    truth = case.truth()
    view = case.view
    pixel_count = view.width_px * view.height_px
    reach_px = 2.0 * radius_px + TILE_SIZE_PX
    methods = list(MERGING)
    if pixel_count * reach_px**2 > MAX_EVALUATIONS:
        methods.remove("unmerged")
    rows, pictures = [], {}
    for method in methods:
        frames = _frames(case, MERGING[method])
        last = frames[-1]
        work = counted_work(case.renderer, view, last)
        pictures[method] = last.color.astype(np.float64)
        merging_db = None
        if method == "merged" and "unmerged" in pictures:
            merging_db = channel_psnr_db(pictures["merged"], pictures["unmerged"])
        totals_ms = [sum(frame.stage_times_ms.values()) for frame in frames]
        rows.append(
            CostRow(
                bench="cost",
                method=method,
                case=name,
                setting=f"{view.width_px}x{view.height_px} {radius_px:.1f} px",
                n=len(frames),
                median_ms=float(np.median(totals_ms)),
                p95_ms=float(np.percentile(totals_ms, 95)),
                memory_mb=working_memory_mb(case.renderer),
                error_name="psnr_db",
                error=channel_psnr_db(pictures[method], truth),
                reference=case.reference_name,
                sweep=sweep,
                radius_px=radius_px,
                pixel_count=pixel_count,
                fragment_count=last.fragment_count,
                merged_ratio=last.merged_count / pixel_count,
                entry_count=last.entry_count,
                evaluation_count=work.evaluation_count,
                lit_count=work.lit_count,
                kernel_count=last.kernel_count,
                kernel_texel_count=last.kernel_texel_count,
                layer_count=last.layer_count,
                merging_db=merging_db,
                stage_ms=_stages(frames),
            )
        )
        print(_work(rows[-1]), file=sys.stderr, flush=True)
    case.handle.release()
    return rows


def _frames(case: CostBench, merge: bool) -> list:
    """Frames whose kernels are made anew: one, or as many as the budget allows."""
    options = {**case.state, "merge": merge}
    run = timed_frames(case.renderer, case.view, case.handle, repeats=1, **options)
    repeats = min(int(BUDGET_MS / run.median_ms), MAX_REPEATS)
    if repeats > 1:
        run = timed_frames(
            case.renderer, case.view, case.handle, repeats=repeats, **options
        )
    return run.frames


def _stages(frames: list) -> dict[str, float]:
    return {
        name.removesuffix("_ms"): float(
            np.median([frame.stage_times_ms[name] for frame in frames])
        )
        for name in frames[0].stage_times_ms
    }


def radius_rows(renderer, radii, size) -> list[CostRow]:
    """Blur radius at one resolution."""
    return [
        row
        for name, make in VIEWS.items()
        for radius_px in radii
        for row in bench(
            CostBench(renderer, make(*size, BLUR_MRAD / radius_px)),
            "radius",
            name,
            float(radius_px),
        )
    ]


def resolution_rows(renderer, sizes) -> list[CostRow]:
    """Resolution at one radius, and at one field of view, whose blur grows with it."""
    rows = []
    for size in sizes:
        up = math.tan(math.radians(VERTICAL_FOV_DEG / 2))
        pixels_mrad = {
            f"plane, {FIXED_RADIUS_PX} px": BLUR_MRAD / FIXED_RADIUS_PX,
            f"plane, {VERTICAL_FOV_DEG:.0f} deg": 2000.0 * up / size[1],
        }
        for name, pixel_mrad in pixels_mrad.items():
            case = CostBench(renderer, plane_view(*size, pixel_mrad))
            rows += bench(case, "resolution", name, BLUR_MRAD / pixel_mrad)
    return rows


def kernel_rows(renderer, size, steps_px, modes) -> list[CostRow]:
    """Kernels by layers (finer blur steps) and by cells (over the field)."""
    rows = []
    view = courtyard_view(*size, BLUR_MRAD / STEPS_RADIUS_PX)
    view = replace(view, depth_m=view.depth_m / LAYERS_NEARER)
    for step_px in steps_px:
        case = CostBench(renderer, view, max_blur_step_px=step_px)
        rows += bench(case, "kernels", "courtyard, layers", float(STEPS_RADIUS_PX))
    for mode in modes:
        case = FieldBench(renderer, size, mode)
        rows += bench(case, "kernels", "courtyard, cells", 0.0)
    return rows


def main() -> None:
    """Run, print, and write tests/benchmarks/results/cost.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180, up to 8 px")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", action="store_true", help="results/cost.png")
    parser.add_argument("--sweeps", nargs="+", choices=SWEEPS, default=SWEEPS)
    arguments = parser.parse_args()
    is_whole = arguments.sweeps == SWEEPS and not arguments.quick
    quick = arguments.quick
    renderer = open_renderer("gl")  # which tells what it evaluates
    size = QUICK["size"] if quick else SIZE
    rows = []
    if "radius" in arguments.sweeps:
        rows += radius_rows(renderer, QUICK["radii"] if quick else RADII_PX, size)
    if "resolution" in arguments.sweeps:
        rows += resolution_rows(renderer, QUICK["sizes"] if quick else SIZES)
    if "kernels" in arguments.sweeps:
        steps_px = BLUR_STEPS_PX[::2] if quick else BLUR_STEPS_PX
        modes = FIELD_MODES[:2] if quick else FIELD_MODES
        rows += kernel_rows(renderer, size, steps_px, modes)
    content = report(rows, machine={**machine_info(), "renderer": renderer.name})
    content["laws"] = [asdict(law) for law in laws(rows)]
    content["bounds"] = [asdict(bound) for bound in bounds(rows)]
    if arguments.json:
        print(json.dumps(content))
    else:
        print(*map(_work, rows), sep="\n")
        print_laws(content)
    if arguments.plot:
        plot_costs(rows, (RESULTS if is_whole else OUT) / "cost.png")
    if is_whole:
        write_report("cost", content)


def _work(row: CostRow) -> str:
    """What there was to do, and what merging cost."""
    merging = "" if row.merging_db is None else f", merging {row.merging_db:.1f} dB"
    return (
        f"{row.case:<20}{row.method:<10}{row.setting:<18}{row.median_ms:9.1f} ms "
        f"{row.error:5.1f} dB, {row.evaluation_count:.3g} evaluations, "
        f"{row.lit_count / row.evaluation_count:.0%} lit, "
        f"{row.kernel_count} kernels of {row.layer_count} layers, "
        f"{row.merged_ratio:.0%} merged{merging}"
    )


def print_laws(content: dict) -> None:
    """Exponents, and what bounds each pass."""
    for law in content["laws"]:
        print(
            f"{law['case']:<20}{law['method']:<10}{law['quantity']:<14}"
            f"~ {law['against']} ^ {law['exponent']:.2f} "
            f"(last {law['last_exponent']:.2f})"
        )
    for bound in content["bounds"]:
        print(
            f"{bound['stage']:<14}{bound['ns_per_unit']:9.3g} ns per {bound['unit']}, "
            f"x{bound['spread_ratio']:.1f} over rows"
        )


if __name__ == "__main__":
    main()
