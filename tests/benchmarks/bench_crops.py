"""Crops of a photograph, compared with PSFs computed by independent quadrature.

    python -m tests.benchmarks.bench_crops [--quick] [--json]

The part of highest contrast of a photograph from scikit-image, 64x64 pixels of 0.9 mrad
(those of 1280x720 at 60 degrees), at one distance and 6 degrees beside the axis,
through keratoconus and a post-LASIK eye at 3 and 5 mm.  The reference gives every 4
pixels (0.2 degrees) PSFs of their own, computed by float64 quadrature of the
diffraction integral on the traced wavefronts, which takes 5 minutes a crop; the frame
has the usual tolerance and the default ranges, and a new pupil each time, as in a
stream.  Error: PSNR of the picture as encoded for a screen, of the crop but for its
outermost 8 pixels, and the 5th percentile of its blocks of 32x32 pixels; beside them
that of the dense reference by the program's own PSFs.  Writes results/crops.json.
"""

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from estimator.threads import thread_count
from filter_service.planning.grid import GridSpec
from filter_service.planning.plan import plan_axes
from filter_service.psfs.store import PsfStore
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.bench_levels import encoded
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.benchmarks.photograph import motorcycle
from tests.benchmarks.view_sources import EyeState
from tests.numerical.plan_cases import traced_eye
from tests.reference.psf_integral import reference_kernel

EYES = ("keratoconus", "post_lasik")
PUPILS_MM = (3.0, 5.0)
SIDE_PX, BORDER_PX, BLOCK_PX, BLOCK_STEP_PX = 64, 8, 32, 4
PIXEL_TANGENT = 2.0 * np.tan(np.radians(30.0)) / 1280.0
AWAY_DEG = 6.0
DISTANCE_DPT, FOCUS_DPT = 1.0, 0.5
REFERENCE = "float64 quadrature, encoded"


@dataclass(frozen=True)
class QuadratureState(EyeState):
    """An eye whose PSFs are integrated, on the rasters that `compute_psf_batch` has."""

    def exact_psfs(
        self, h_deg: NDArray, v_deg: NDArray, distance_dpt: NDArray, **options: int
    ) -> PsfBatch:
        """PSFs (3 n) of n places in the field, channel fastest."""
        like = super().exact_psfs(h_deg, v_deg, distance_dpt, **options)
        arguments = self.wavefront_arguments(h_deg, v_deg, distance_dpt)
        found = self.eye.wavefronts(**arguments)
        scale = self.spec.pixel_from_mrad(arguments["h_deg"], arguments["v_deg"])

        def integrated(number: int) -> NDArray[np.float32]:
            kernel = reference_kernel(
                found.zernike_um[number],
                pupil_diameter_mm=float(found.circle_diameter_mm[number]),
                pupil_ellipse=found.pupil_ellipse[number],
                wavelength_nm=float(arguments["wavelength_nm"][number]),
                pixel_from_mrad=scale[number],
                radius_px=int(like.radius_px[number]),
                workers=1,
            )
            return (kernel / kernel.sum()).astype(np.float32).ravel()

        with ThreadPoolExecutor(thread_count()) as pool:
            kernels = list(pool.map(integrated, range(len(like))))
        return PsfBatch(
            flat_kernels=np.concatenate(kernels),
            offset_count=np.cumsum([0, *(k.size for k in kernels[:-1])]),
            radius_px=like.radius_px,
            lost_energy_ratio=like.lost_energy_ratio,
            blur_radius_px=like.blur_radius_px,
            geometric_ratio=np.zeros(len(like)),
            wave_method="quadrature",
        )


def crop() -> RgbdView:
    """Return the part of the photograph with the highest contrast."""
    color, _ = motorcycle(1280, 720)
    light = color.mean(axis=2)
    corners = [
        (y, x)
        for y in range(0, light.shape[0] - SIDE_PX, 24)
        for x in range(0, light.shape[1] - SIDE_PX, 24)
    ]
    y, x = max(
        corners,
        key=lambda c: np.abs(
            np.diff(light[c[0] : c[0] + SIDE_PX, c[1] : c[1] + SIDE_PX], axis=1)
        ).mean(),
    )
    middle, half = np.tan(np.radians(AWAY_DEG)), PIXEL_TANGENT * SIDE_PX / 2.0
    return RgbdView(
        np.ascontiguousarray(color[y : y + SIDE_PX, x : x + SIDE_PX]),
        np.full((SIDE_PX, SIDE_PX), 1.0 / DISTANCE_DPT, np.float32),
        (middle - half, middle + half, half, -half),
        depth_kind="radial",
    )


def errors_db(seen: NDArray, truth: NDArray) -> tuple[float, float]:
    """PSNR of the inner part, and the 5th percentile of its blocks."""
    inner = slice(BORDER_PX, SIDE_PX - BORDER_PX)
    square = ((encoded(seen) - encoded(truth)) ** 2)[inner, inner].mean(axis=-1)
    places = range(0, square.shape[0] - BLOCK_PX + 1, BLOCK_STEP_PX)
    blocks = [
        square[y : y + BLOCK_PX, x : x + BLOCK_PX].mean()
        for y in places
        for x in places
    ]
    return (
        -10.0 * float(np.log10(square.mean())),
        -10.0 * float(np.log10(np.percentile(blocks, 95))),
    )


def rows_of(eye_name: str, pupil_mm: float) -> list[Row]:
    """Rows of one crop."""
    view = crop()
    spec = GridSpec(view.camera, FilterSettings())
    eye = traced_eye(eye_name, spec)
    renderer = NativeRenderer()
    handle = renderer.load(PsfStore(eye, spec, plan_axes(eye, spec)))
    state = {"pupil_diameter_mm": pupil_mm, "focus_dpt": FOCUS_DPT}
    renderer.render(view, handle, **state)
    times_ms = []
    for k in range(9):  # the pupil changes in every frame, as in a stream
        moved = state | {"pupil_diameter_mm": pupil_mm + (0.0, 0.02)[k % 2]}
        begin_s = time.perf_counter()
        seen = renderer.render(view, handle, **moved)
        times_ms.append(1e3 * (time.perf_counter() - begin_s))
    truth, usual = (
        dense_reference(
            view, kind(eye, spec, pupil_mm, FOCUS_DPT), bins=True, kept=False
        )
        for kind in (QuadratureState, EyeState)
    )
    median_ms, p95_ms = np.percentile(times_ms, (50, 95))
    values = (*errors_db(seen.color, truth), errors_db(usual, truth)[0])
    names = ("whole crop, dB", "5 % of blocks, dB", "dense reference, dB")
    return [
        Row(
            *("crops", eye_name, f"{pupil_mm:g} mm"),
            f"{handle.store.computed_count} PSFs",
            *(len(times_ms), float(median_ms), float(p95_ms), memory_mb()),
            *(name, value, REFERENCE),
        )
        for name, value in zip(names, values, strict=True)
    ]


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye at 3 mm")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    cases = [(eye, pupil_mm) for eye in EYES for pupil_mm in PUPILS_MM]
    if arguments.quick:
        cases = cases[:1]
    rows = [row for case in cases for row in rows_of(*case)]
    publish("crops", rows, as_json=arguments.json, is_whole=not arguments.quick)


if __name__ == "__main__":
    main()
