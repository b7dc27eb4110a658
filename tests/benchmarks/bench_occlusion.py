"""Occlusion with one and two layers, compared with rays traced through a lens.

Usage: python -m tests.benchmarks.bench_occlusion [--quick] [--json] [--engine NAME]

Error: PSNR in linear light against rays through a thin lens
(`tests.reference.lens_picture`), over the whole picture, and over the band that light from both sides of an edge reaches.  The eye
has no aberrations but defocus, for that is what the reference has.  Fragments are not
merged, for that has an error of its own, edges or not; one method has them merged.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.psfs.store import build_psf_store
from tests.benchmarks.engines import ENGINES, open_renderer, working_memory_mb
from tests.benchmarks.harness import (
    Row,
    machine_info,
    memory_mb,
    print_rows,
    report,
    time_calls,
    write_report,
)
from tests.benchmarks.occlusion_scenes import Scene, client_scene, synthetic_scenes
from tests.grid_specs import grid_spec
from tests.numerical.synthetic import psnr_db
from tests.reference.lens_picture import RAY_COUNT

EYE = {"kind": "prescription", "sphere_dpt": 0.0}
ONE_LAYER = {"hidden_color": None, "hidden_depth_m": None}
METHODS = {
    # method: what of the view is left out, options of the renderer
    "one layer paper": (ONE_LAYER, {"accumulation": "paper", "merge": False}),
    "one layer": (ONE_LAYER, {"merge": False}),
    "two layers paper": ({}, {"accumulation": "paper", "merge": False}),
    "two layers": ({}, {"merge": False}),
    "two layers merged": ({}, {}),
}


def scene_rows(renderer, scene: Scene, repeats: int, ray_count: int) -> list[Row]:
    """Two rows of each method: the whole picture, and the band around edges."""
    view = scene.view
    setting = f"{view.width_px}x{view.height_px} {scene.pupil_diameter_mm:g} mm"
    start_s = time.perf_counter()
    truth = scene.traced(ray_count=ray_count)
    trace_ms = 1e3 * (time.perf_counter() - start_s)
    band = scene.edge_band()
    handle = renderer.load(_store(scene))
    state = {
        "pupil_diameter_mm": scene.pupil_diameter_mm,
        "focus_dpt": scene.focus_dpt,
    }

    def rows(method, n, median_ms, p95_ms, used_mb, image) -> list[Row]:
        errors = {
            "psnr_db": psnr_db(image, truth),
            "edge_psnr_db": psnr_db(image[band], truth[band]),
        }
        return [
            Row(
                bench="occlusion",
                method=method,
                case=scene.name,
                setting=setting,
                n=n,
                median_ms=median_ms,
                p95_ms=p95_ms,
                memory_mb=used_mb,
                error_name=name,
                error=error,
                reference=f"{ray_count} rays a pixel through a thin lens",
            )
            for name, error in errors.items()
        ]

    # How far the reference itself is off: it changes by this with half the rays.
    fewer = scene.traced(ray_count=ray_count // 2)
    found = rows("half the rays", 1, trace_ms / 2, trace_ms / 2, memory_mb(), fewer)
    for method, (left_out, options) in METHODS.items():
        shown = replace(view, **left_out)
        results = []

        def filtered(shown=shown, options=options, results=results):
            results.append(renderer.render(shown, handle, **state, **options))

        times_ms = time_calls(filtered, repeats=repeats)
        color = results[-1].color.astype(np.float64)
        found += rows(method, repeats, *times_ms, working_memory_mb(renderer), color)
    handle.release()
    return found


def _store(scene: Scene):
    held = [d[d >= 0.0] for d in scene.distances_dpt]
    spec = grid_spec(
        width_px=scene.view.width_px,
        height_px=scene.view.height_px,
        tangents=scene.view.tangents,
        pupil_range_mm=(scene.pupil_diameter_mm,) * 2,
        focus_range_dpt=(scene.focus_dpt,) * 2,
        object_range_dpt=(0.0, max(float(d.max()) for d in held if d.size)),
        diffraction=False,
        chromatic=False,
    )
    return build_psf_store(parse_profile(EYE), spec)


def main() -> None:
    """Run, print, and write tests/benchmarks/results/occlusion.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small synthetic scenes")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    arguments = parser.parse_args()
    renderer = open_renderer(arguments.engine)
    if arguments.quick:
        scenes = synthetic_scenes(width_px=160, height_px=90)[:4]
    else:
        scenes = synthetic_scenes(width_px=320, height_px=180)
        scenes += [
            client_scene(name, width_px=640, height_px=360)
            for name in ("courtyard", "primitives")
        ]
    repeats = 3 if arguments.quick else 7
    ray_count = RAY_COUNT
    rows = [
        row
        for scene in scenes
        for row in scene_rows(renderer, scene, repeats, ray_count)
    ]
    content = report(rows, machine={**machine_info(), "renderer": renderer.name})
    if arguments.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    if not arguments.quick:
        write_report("occlusion", content)


if __name__ == "__main__":
    main()
