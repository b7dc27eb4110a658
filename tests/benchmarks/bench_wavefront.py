"""Time of ray tracing and of wavefronts, each with its error.

    python -m tests.benchmarks.bench_wavefront [--quick] [--json]

Cases: the Navarro eye of the reference data, and an eye without symmetry (offset terms,
toric surfaces, tilted lens).  Errors are largest differences over the 27 coefficients,
or positions after tracing in and out again.
"""

import argparse

import numpy as np

from estimator.eye.assembly import pack_eyes
from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import eye_indices
from estimator.optics.raytrace import trace_rays
from estimator.optics.surfaces import media_indices, pack_eye
from estimator.optics.zernike import rescale_pupil
from estimator.wavefront.aberrations import (
    on_axis_zernike,
    wavefront_aberrations,
    wavefront_grid,
)
from estimator.wavefront.nodes import N_AZIMUTHS, N_REFERENCE_RINGS, N_RINGS
from tests.benchmarks.harness import (
    Row,
    memory_mb,
    publish,
    time_calls,
)
from tests.numerical.schematic_eyes import irregular_eye, navarro, reference

WAVELENGTHS_NM = (612.0, 549.0, 464.0)
H_DEG, V_DEG = np.linspace(-45.0, 45.0, 19), np.linspace(-25.0, 25.0, 11)
PUPIL_MM = 5.0
N_DENSE_AZIMUTHS = 64
N_BATCH = 200
CIRCLE_MM = 2.5


def _row(method, case, setting, n, times, error_name, error, against):
    return Row(
        "wavefront",
        method,
        case,
        setting,
        n,
        *times,
        memory_mb(),
        error_name,
        float(error),
        against,
    )


def _difference_um(zernike_um, radius_mm, other_um, other_radius_mm):
    moved = rescale_pupil(zernike_um, radius_ratio=other_radius_mm / radius_mm)
    return np.abs(moved - other_um)[..., 1:].max()


def ray_row(name, eye, repeats):
    """Cost of one ray at one surface, and what going back by the same way misses."""
    rng, count = np.random.default_rng(3), 20000
    start = np.concatenate([rng.uniform(-2, 2, (count, 2)), np.full((count, 1), -4)], 1)
    direction = np.concatenate(
        [rng.uniform(-0.3, 0.3, (count, 2)), np.ones((count, 1))], axis=1
    )
    view = {"wavelength_nm": 555.0}
    inward = trace_rays(eye, start_mm=start, direction=direction, **view)
    whole = inward.status_index == 0
    back = trace_rays(
        eye,
        start_mm=inward.points_mm[whole, -1],
        direction=-inward.direction_ratio[whole, -1],
        reverse=True,
        **view,
    )
    error = np.abs(back.points_mm[:, 0] - inward.points_mm[whole, 0]).max()
    n_surfaces = len(eye.surfaces) + 1
    times = time_calls(
        lambda: trace_rays(eye, start_mm=start, direction=direction, **view),
        repeats=repeats,
        per_call=count * n_surfaces,
    )
    setting = f"per ray-surface, 1 thread, {1e6 * times[0]:.0f} ns"
    return _row("trace", name, setting, count, times, "return_mm", error, "itself")


def single_rows(name, eye, repeats):
    """One evaluation at a time: three fields against the dense rule."""
    for h_deg, v_deg, stop_mm in (
        (0.0, 0.0, 4.0),
        (20.0, 10.0, 5.0),
        (45.0, 26.0, 7.0),
    ):
        view = {
            "wavelength_nm": 555.0,
            "stop_diameter_mm": stop_mm,
            "h_deg": h_deg,
            "v_deg": v_deg,
        }
        found = wavefront_aberrations(eye, **view)
        dense = wavefront_aberrations(
            eye, n_rings=N_REFERENCE_RINGS, n_azimuths=N_DENSE_AZIMUTHS, **view
        )
        error = _difference_um(
            found.zernike_um,
            found.zernike_radius_mm,
            dense.zernike_um,
            dense.zernike_radius_mm,
        )
        times = time_calls(
            lambda view=view: wavefront_aberrations(eye, **view), repeats=repeats
        )
        setting = f"{h_deg:g},{v_deg:g} deg, stop {stop_mm:g} mm"
        n_rays = N_RINGS * N_AZIMUTHS
        against = f"{N_REFERENCE_RINGS * N_DENSE_AZIMUTHS} rays"
        yield _row("single", name, setting, n_rays, times, "max_um", error, against)


def grid_row(name, eye, repeats):
    """The off-axis grid of the paper: 19 x 11 fields, 3 wavelengths, 5 mm pupil."""
    fields_deg = np.stack(np.meshgrid(H_DEG, V_DEG, indexing="ij"), -1).reshape(-1, 2)
    given = {"wavelengths_nm": WAVELENGTHS_NM, "pupil_diameters_mm": [PUPIL_MM]}
    found = wavefront_grid(eye, fields_deg=fields_deg, **given)
    some = slice(None, None, 11)
    dense = wavefront_grid(
        eye,
        fields_deg=fields_deg[some],
        n_rings=N_REFERENCE_RINGS,
        n_azimuths=N_DENSE_AZIMUTHS,
        **given,
    )
    error = _difference_um(
        found.zernike_um[some],
        found.zernike_radius_mm[some],
        dense.zernike_um,
        dense.zernike_radius_mm,
    )
    times = time_calls(
        lambda: wavefront_grid(eye, fields_deg=fields_deg, **given), repeats=repeats
    )
    setting = f"19x11x3, pupil {PUPIL_MM:g} mm, 2 threads"
    count = len(fields_deg) * len(WAVELENGTHS_NM)
    return _row("grid", name, setting, count, times, "max_um", error, "dense rays")


def rescale_rows(name, eye):
    """Several pupils from one trace: error of rescaling against tracing each."""
    for h_deg, v_deg in ((0.0, 0.0), (20.0, 10.0), (45.0, 25.0)):
        for large_mm, small_mm in ((5.0, 4.0), (5.0, 3.0), (7.0, 4.0), (7.0, 2.0)):
            found = wavefront_grid(
                eye,
                fields_deg=[[h_deg, v_deg]],
                wavelengths_nm=[549.0],
                pupil_diameters_mm=[large_mm, small_mm],
            )
            (large, small), radii = (
                found.zernike_um[0, 0],
                found.zernike_radius_mm[0, 0],
            )
            error = _difference_um(large, radii[0], small, radii[1])
            yield _row(
                "rescale",
                name,
                f"{h_deg:g},{v_deg:g} deg, {large_mm:g} to {small_mm:g} mm",
                1,
                (0.0, 0.0),
                "max_um",
                error,
                "traced",
            )


def circle_rows(repeats):
    """Estimation's evaluation: many eyes on one circle on axis."""
    packed = np.repeat(pack_eye(irregular_eye())[None], N_BATCH, axis=0)
    indices = media_indices(irregular_eye(), 555.0)
    import estimator.wavefront.aberrations as wavefront
    from estimator.wavefront.nodes import circle_nodes

    view = {"zernike_radius_mm": CIRCLE_MM}
    found, _ = on_axis_zernike(packed[:1], indices, **view)
    usual, dense = wavefront.circle_nodes, circle_nodes(12, 40)
    wavefront.circle_nodes = lambda *_: dense
    exact, _ = on_axis_zernike(packed[:1], indices, **view)
    wavefront.circle_nodes = usual
    error = np.abs(found - exact).max()
    for n_threads in (1, 2):
        times = time_calls(
            lambda n=n_threads: on_axis_zernike(packed, indices, n_threads=n, **view),
            repeats=repeats,
            per_call=N_BATCH,
        )
        setting = f"per eye, 5 mm, {n_threads} thread(s)"
        yield _row(
            "circle", "irregular", setting, N_BATCH, times, "max_um", error, "480 rays"
        )


def random_row(quick):
    """Random eyes of the paper's box traced on axis: every nan must have a status."""
    count = 10_000 if quick else 100_000
    packed = pack_eyes(random_vectors(count, np.random.default_rng(132)))
    indices = eye_indices(555.0)
    outcome = []

    def trace():
        outcome[:] = on_axis_zernike(packed, indices, zernike_radius_mm=CIRCLE_MM)

    times = time_calls(trace, repeats=1, per_call=count)
    zernike_um, status = outcome
    lost = np.isnan(zernike_um).any(axis=1)
    unexplained = np.count_nonzero(lost & (status == 0))
    setting = f"{count} eyes, {lost.sum()} lost, {1000.0 / times[0]:.0f} eyes/s"
    return _row(
        *("random eyes", "box", setting, count, times),
        *("unexplained_nan", unexplained, "status"),
    )


def measure(quick):
    """All rows."""
    repeats = 3 if quick else 20
    rows = []
    for name, eye in (
        ("navarro", navarro(reference())),
        ("irregular", irregular_eye()),
    ):
        rows.append(ray_row(name, eye, repeats))
        rows += single_rows(name, eye, repeats)
        rows.append(grid_row(name, eye, repeats))
        rows += rescale_rows(name, eye)
    rows += circle_rows(repeats)
    rows.append(random_row(quick))
    return rows


def main():
    """Print the table, or the report as JSON; a full run is also written to a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats and eyes")
    parser.add_argument("--json", action="store_true", help="print JSON only")
    options = parser.parse_args()
    rows = measure(options.quick)
    publish("wavefront", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
