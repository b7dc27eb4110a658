"""Time per packed kernel: boxes computed directly, and discs that are packed.

    python -m tests.benchmarks.bench_kernels [--quick] [--json]

Both compute the same PSFs in turn: 3,000 of the lattice of each of six eyes at
1280x720; defocus of a sharp eye whose blur is 3 to 22 px at 0.73 mrad a pixel; and the
paper's set, 201,825 PSFs of one eye.  Times are of the processor, a PSF, over the
wavefront, its survey, the PSF and its packing; the setting has the wall time on all
cores.  Error: relative L2 of a sample of 536 nm kernels against the float64 quadrature,
median and 95th percentile.  Writes results/kernels.json.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.optics.units import SPHERE_PER_C20
from estimator.psf.compute import compute_psf_batch
from filter_service.constants import RGB
from filter_service.planning.node_wavefronts import NodeWavefronts
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.compute_kernels import (
    PsfEngine,
    computed_kernels,
    generic_kernels,
    psf_engine,
)
from filter_service.psfs.pack import PackedKernels
from filter_service.psfs.store import PsfStore
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.benchmarks.psf_rates import FOCUSES_DPT, PUPILS_MM, traced_slices
from tests.benchmarks.published_figures import CONDITIONS
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.reference.packed_kernels import square_kernel
from tests.reference.psf_integral import reference_kernel

COUNT = 3000
CHUNK = 2048
REPEATS = 3
SAMPLE = 24
GREEN = 1
REFERENCE = "float64 quadrature"
BLURS_PX = (3.0, 5.0, 7.0, 15.0, 22.0)
PITCH_MRAD = 0.73
PUPIL_MM = 4.0
WIDEST_PX = 40
"""Reach of sampled kernels: the quadrature of wider ones takes minutes."""

Compute = Callable[[NDArray[np.int64]], PackedKernels]

DISCS = PsfEngine(compute_psf_batch, 1024)


def unit_kernel(
    packed: PackedKernels, number: int, radius_px: int
) -> NDArray[np.float64]:
    """Kernel (2R+1, 2R+1) of unit sum; what reaches beyond is left out."""
    reach = packed.reach_px[number]
    own = int(max(reach.max(), packed.radius_px[number]))
    square = square_kernel(packed.weights, int(packed.offsets[number]), reach, own)
    square /= square.sum()
    if own > radius_px:
        return square[own - radius_px : own + radius_px + 1][
            :, own - radius_px : own + radius_px + 1
        ]
    return np.pad(square, radius_px - own)


def timed(compute: Compute, psfs: NDArray[np.int64]) -> tuple[list[float], list[float]]:
    """Processor and wall times (REPEATS,) in us a PSF; in chunks, as a store fills."""
    chunks = np.array_split(psfs, -(-psfs.size // CHUNK))
    processor_us, wall_us = [], []
    for repeat in range(REPEATS + 1):
        begin_s, used_s = time.perf_counter(), time.process_time()
        for chunk in chunks:
            compute(chunk)
        if repeat:  # the first compiles, and fills caches
            wall_us.append(1e6 * (time.perf_counter() - begin_s) / psfs.size)
            processor_us.append(1e6 * (time.process_time() - used_s) / psfs.size)
    return processor_us, wall_us


def rows_of(
    case: str,
    wavefronts: NodeWavefronts,
    total_dpt: Callable[[NDArray[np.int64]], NDArray[np.float64]],
    group_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    psfs: NDArray[np.int64],
    engines: dict[str, Compute],
    sample: int = SAMPLE,
) -> list[Row]:
    """Rows of both engines for some PSFs of nodes."""
    # Green ones that the quadrature can do.
    green = psfs[psfs % RGB == GREEN]
    few = engines["C"](green)
    cheap = np.flatnonzero(few.reach_px.max(axis=1) <= WIDEST_PX)
    cheap = cheap[np.linspace(0, cheap.size - 1, min(sample, cheap.size)).astype(int)]
    picked = green[cheap]
    truths = []
    for psf, number in zip(picked, cheap, strict=True):
        group, channel = int(group_of(psf[None])[0]), int(psf % RGB)
        found = wavefronts.at(
            np.array([group]), np.array([channel]), total_dpt(psf[None])
        )
        radius_px = int(few.reach_px[number].max())
        truth = reference_kernel(
            found.zernike_um[0],
            pupil_diameter_mm=float(found.circle_diameter_mm[0]),
            wavelength_nm=float(wavefronts.wavelength_nm[channel, 0]),
            radius_px=radius_px,
            pixel_from_mrad=wavefronts.pixel_from_mrad[group],
            pupil_ellipse=found.pupil_ellipse[0],
        )
        truths.append(truth / truth.sum())
    rows = []
    for method, compute in engines.items():
        kernels = compute(picked)
        errors = []
        for number, truth in enumerate(truths):
            found = unit_kernel(kernels, number, truth.shape[0] // 2)
            errors.append(np.linalg.norm(found - truth) / np.linalg.norm(truth))
        processor_us, wall_us = timed(compute, psfs)
        for name, share in (("L2, median", 50), ("L2, p95", 95)):
            rows.append(
                Row(
                    *("kernels", method, case, f"wall {min(wall_us):.1f} us"),
                    *(psfs.size, 1e-3 * min(processor_us), 1e-3 * max(processor_us)),
                    *(memory_mb(), name, float(np.percentile(errors, share))),
                    REFERENCE,
                )
            )
    ratio = rows[2].median_ms / rows[0].median_ms
    print(
        f"{case:24} C {1e3 * rows[0].median_ms:6.1f} us ({rows[0].setting}), discs "
        f"{1e3 * rows[2].median_ms:6.1f} us: {ratio:.1f} times; L2 median, p95: "
        f"C {rows[0].error:.4f}, {rows[1].error:.4f}, discs {rows[2].error:.4f}, "
        f"{rows[3].error:.4f}",
        flush=True,
    )
    return rows


def lattice_rows(eye_name: str, count: int) -> list[Row]:
    """Rows of an eye's lattice at 1280x720."""
    spec = spec_for(1280, 720, mode="dynamic")
    eye = traced_eye(eye_name, spec)
    plan = unchecked_plan(eye, spec)  # all ranges, whose PSFs may exceed the budget
    store = PsfStore(eye, spec, plan)
    rng = np.random.default_rng(1)
    # Whole nodes, and neighbours in defocus together, as a frame needs them.
    first = rng.choice(store.psf_count // 30, count // 30, replace=False)
    psfs = (30 * np.sort(first)[:, None] + np.arange(30)).ravel()
    engines = {
        name: lambda some, engine=engine: computed_kernels(
            eye, spec, store.nodes, some, engine
        )[0]
        for name, engine in (("C", psf_engine()), ("discs", DISCS))
    }

    def total_dpt(some):
        groups = plan.nodes.defocus.group_at(some // RGB)
        shift = plan.nodes.channel_shift_dpt[groups, some % RGB]
        return plan.nodes.defocus.values_dpt[some // RGB] + shift

    return rows_of(
        f"lattice {eye_name}",
        store.nodes.wavefronts,
        total_dpt,
        lambda some: plan.nodes.defocus.group_at(some // RGB),
        psfs,
        engines,
    )


def engines_of(wavefronts: NodeWavefronts, eye, spec) -> dict[str, Compute]:
    """Both engines for PSFs 3 group + channel at 0 dpt."""
    native = psf_engine().native

    def by_c(psfs):
        packed, _, left = native.kernels(
            wavefronts,
            *(psfs // RGB, psfs % RGB, np.zeros(psfs.size)),
            kept_energy_ratio=spec.kept_energy_ratio,
            max_radius_px=spec.max_blur_radius_px,
        )
        assert not left.size
        return packed

    def by_discs(psfs):
        return generic_kernels(
            *(eye, spec, wavefronts, DISCS),
            *(psfs // RGB, psfs % RGB, np.zeros(psfs.size)),
        )[0]

    return {"C": by_c, "discs": by_discs}


def nodes_of(zernike_um, circle_mm, ellipse, wavelength_nm, jacobian) -> NodeWavefronts:
    """Nodes of wavefronts (n, 3, 28), everything else alike."""
    count = len(zernike_um)
    return NodeWavefronts(
        zernike_um=zernike_um[:, :, None],
        per_dpt_um=np.zeros((count, RGB, 1, 28)),
        circle_diameter_mm=circle_mm[:, :, None],
        pupil_ellipse=ellipse[:, :, None],
        wavelength_nm=np.asarray(wavelength_nm, float).reshape(RGB, 1),
        pixel_from_mrad=jacobian,
        h_deg=np.zeros(count),
        v_deg=np.zeros(count),
    )


def blur_rows(eye, spec, count: int) -> list[Row]:
    """Rows of a sharp eye out of focus, by the radius of its blur."""
    rows = []
    for blur_px in BLURS_PX:
        # a slope of D r mrad at the pupil's rim r mm
        dpt = blur_px * PITCH_MRAD / (PUPIL_MM / 2.0)
        spread = np.linspace(0.97, 1.03, count)
        zernike_um = np.zeros((count, RGB, 28))
        zernike_um[:, :, 4] = (dpt * spread * (PUPIL_MM / 2.0) ** 2 / SPHERE_PER_C20)[
            :, None
        ]
        radius_mm = PUPIL_MM / 2.0
        wavefronts = nodes_of(
            zernike_um,
            np.full((count, RGB), PUPIL_MM),
            np.broadcast_to((0.0, 0.0, radius_mm, radius_mm, 0.0), (count, RGB, 5)),
            (536.0, 536.0, 536.0),
            np.broadcast_to(np.eye(2) / PITCH_MRAD, (count, 2, 2)).copy(),
        )
        rows += rows_of(
            f"blur {blur_px:g} px",
            wavefronts,
            lambda some: np.zeros(some.size),
            lambda some: some // RGB,
            np.arange(RGB * count),
            engines_of(wavefronts, eye, spec),
            sample=8,
        )
    return rows


def paper_rows(eye, spec) -> list[Row]:
    """Rows of the paper's set: 25 slices of 8,073 PSFs."""
    parts = traced_slices("emmetropia", PUPILS_MM, FOCUSES_DPT)
    zernike_um = np.concatenate([part.zernike_um for part in parts])
    options = {
        name: np.concatenate([part.options[name] for part in parts])
        for name in parts[0].options
    }
    count = len(zernike_um) // RGB
    wavefronts = nodes_of(
        zernike_um.reshape(count, RGB, 28),
        options["pupil_diameter_mm"].reshape(count, RGB),
        options["pupil_ellipse"].reshape(count, RGB, 5),
        options["wavelength_nm"][:RGB],
        options["pixel_from_mrad"][::RGB].copy(),
    )
    return rows_of(
        "paper's set",
        wavefronts,
        lambda some: np.zeros(some.size),
        lambda some: some // RGB,
        np.arange(RGB * count),
        engines_of(wavefronts, eye, replace(spec, max_blur_radius_px=255)),
    )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye, few PSFs")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    eyes = CONDITIONS[:1] if options.quick else CONDITIONS
    count = 600 if options.quick else COUNT
    rows = [row for name in eyes for row in lattice_rows(name, count)]
    spec = spec_for(1280, 720, mode="dynamic")
    eye = traced_eye("emmetropia", spec)
    rows += blur_rows(eye, spec, 100 if options.quick else 1000)
    if not options.quick:
        rows += paper_rows(eye, spec)
    publish("kernels", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
