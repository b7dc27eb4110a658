"""Records that tell the GPU passes how to build each PSF: sizes, places, coefficients.

From a plan (`psf.compute.plan_psfs`) to what `shaders/common/psf_record.glsl` reads.
No OpenGL here.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import EXPONENTS
from estimator.psf.compute import ACCURACY, PsfPlan
from estimator.psf.fourier import pixel_filter, plan_grids
from estimator.psf.fourier_kernels import EDGE_HALF_WIDTH
from estimator.psf.geometric_kernels import (
    CELLS_PER_PX,
    EDGE_POINTS_PER_PX,
    MAX_CELLS,
    MIN_CELLS,
    MIN_EDGE_POINTS,
)
from estimator.psf.tail import EDGE_STRIDE
from filter_service.psfs.gpu_build_constants import FFT_RADICES, LIGHT_STEP_BITS

MAX_LENGTH = max(FFT_RADICES)
"""Longest FFT of the GPU passes; longer ones are the CPU's."""

_LENGTHS = np.array([*sorted(FFT_RADICES), 2 * MAX_LENGTH, 4 * MAX_LENGTH])

RECORD = np.dtype(
    [
        ("polynomial", "f4", 28),
        ("edge_px", "f4", (12, 2)),
        ("log_amplitude", "f4", 4),
        ("pupil", "f4", 4),
        ("more", "f4", 4),
        ("place", "i4", 4),
        ("light", "f4", 4),
        ("grid", "i4", 4),
        ("pixels", "i4", 4),
        ("window", "i4", 4),
        ("taps", "i4", 4),
    ]
)
"""`PsfRecord` of shaders/common/psf_record.glsl, 16-byte members throughout."""

FIELD_BYTES = 8
"""A complex sample."""


def _coefficient_order() -> NDArray[np.int64]:
    """Return indices into the 28 monomials: by powers of x, within them of y."""
    index = {(int(a), int(b)): i for i, (a, b) in enumerate(EXPONENTS)}
    return np.array([index[a, b] for a in range(7) for b in range(7 - a)])


_ORDER = _coefficient_order()
_TILTS = [
    int(np.flatnonzero(np.all(EXPONENTS == t, axis=1))[0]) for t in ((1, 0), (0, 1))
]


@dataclass(frozen=True)
class Chunk:
    """Consecutive records that one row of dispatches works on.

    Attributes
    ----------
    first, count : int
    lengths : (x, y)
        FFT lengths; (0, 0) with rays.
    scratch_count : int
        Complex samples, or pixels with rays.
    largest : (int, int)
        Most lit rows and 0; most cells and points on the edge with rays.
    """

    first: int
    count: int
    lengths: tuple[int, int]
    scratch_count: int
    largest: tuple[int, int]
    stripe_count: int = 0


@dataclass(frozen=True)
class Jobs:
    """PSFs of one engine, in the order of the work.

    Attributes
    ----------
    members : (M,) int64
        Which PSFs of the plan.
    records : (M,) RECORD
    chunks : list of Chunk
    filter_weights : (n,) float32
        Pixel filters of the waves, one behind the other.
    is_apodised : bool
    """

    members: NDArray[np.int64]
    records: NDArray
    chunks: list[Chunk]
    filter_weights: NDArray[np.float32]
    is_apodised: bool


_NO_JOBS = Jobs(
    members=np.zeros(0, np.int64),
    records=np.zeros(0, RECORD),
    chunks=[],
    filter_weights=np.zeros(0, np.float32),
    is_apodised=False,
)


def kernel_starts(plan: PsfPlan) -> NDArray[np.int64]:
    """Where each kernel (P,) starts, and the end of the last, in elements."""
    ends = np.cumsum((2 * plan.radius_px + 1) ** 2)
    return np.concatenate([[0], ends])


def _common(plan: PsfPlan, members, starts, share, slot) -> NDArray:
    """Make records with what both engines need."""
    survey, frames = plan.survey, plan.survey.frames
    records = np.zeros(members.size, RECORD)
    records["edge_px"] = survey.edge_slope_px[members, ::EDGE_STRIDE]
    records["log_amplitude"] = frames.log_amplitude[members, :4]
    records["pupil"][:, :2] = frames.half_width_um_per_px[members]
    records["pupil"][:, 2] = frames.shear_ratio[members]
    records["pupil"][:, 3] = survey.edge_light_um[members]
    records["more"][:, :2] = frames.log_amplitude[members, 4:]
    records["more"][:, 2] = share
    records["place"][:, 0] = starts[members]
    records["place"][:, 1] = plan.radius_px[members]
    records["place"][:, 2] = 2 * members + slot
    return records


def _cuts(keys: NDArray, sizes: NDArray, limit_count: int) -> list[tuple[int, int]]:
    """Find runs (first, end) of equal keys, cut where their sizes exceed the limit."""
    changes = np.flatnonzero(np.any(keys[1:] != keys[:-1], axis=1)) + 1
    ends, cuts = np.cumsum(sizes), []
    for first, end in pairwise([0, *changes.tolist(), keys.shape[0]]):
        while first < end:
            most = ends[first] - sizes[first] + limit_count
            cut = int(np.searchsorted(ends, most, "right"))
            cuts.append((first, min(end, max(cut, first + 1))))
            first = cuts[-1][1]
    return cuts


def _before(sizes: NDArray, cuts) -> NDArray[np.int64]:
    """Sum of the sizes before each record of its run."""
    ends = np.cumsum(sizes)
    before = ends - sizes
    for first, end in cuts:
        before[first:end] -= before[first]
    return before


def _filters(per_px: NDArray[np.int64], half_width: int):
    """All pixel filters one behind the other; start and reach (M, 2) of each use."""
    counts, which = np.unique(per_px, return_inverse=True)
    filters = [pixel_filter(int(k), half_width) for k in counts]
    sizes = np.array([f.size for f in filters])
    which = which.reshape(per_px.shape)
    return np.concatenate(filters), (np.cumsum(sizes) - sizes)[which], sizes[which] // 2


def _windows(center, per_px, lengths, radius) -> NDArray[np.int64]:
    """Pixels x0, x1, y0, y1 (M, 4) that lie within the FFT window and the kernel."""
    inside = lengths / 2.0 - 1.0
    low = np.ceil((center - inside) / per_px + 0.5).astype(np.int64)
    high = np.floor((center + inside) / per_px - 0.5).astype(np.int64)
    low, high = np.maximum(low, -radius[:, None]), np.minimum(high, radius[:, None])
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1)


def plan_waves(
    plan: PsfPlan,
    members: NDArray[np.int64],
    starts,
    *,
    accuracy: str,
    limit_count: int,
) -> tuple[Jobs, NDArray[np.int64]]:
    """Jobs of the wave method, and the members that need longer FFTs than there are.

    ``limit_count``: complex samples of a chunk.
    """
    if members.size == 0:
        return _NO_JOBS, members
    survey = plan.survey
    rule = ACCURACY[accuracy]
    grids = plan_grids(
        extent_px=survey.extent_px[members],
        unit_px=survey.unit_px[members],
        accuracy=rule,
        lengths=_LENGTHS,
    )
    is_long = grids.length_count.max(axis=1) > MAX_LENGTH
    # Neither side much shorter than the other: fewer pairs of lengths, fuller batches.
    longest = grids.length_count.max(axis=1)
    half = _LENGTHS[np.searchsorted(_LENGTHS, longest // 2)]
    lengths = np.maximum(grids.length_count, half[:, None])
    order = np.lexsort((lengths[:, 1], lengths[:, 0]))
    order = order[~is_long[order]]
    if order.size == 0:
        return _NO_JOBS, members
    lengths, kept = lengths[order], members[order]
    per_px = grids.samples_per_px_count[order]
    # A longer transform samples the pupil finer: the window grows, the angle's step
    # stays.
    unit_px = survey.unit_px[kept]
    samples = lengths / (per_px * unit_px)
    records = _common(plan, kept, starts, 1.0 - plan.geometric_ratio[kept], 0)
    return _wave_jobs(
        plan, kept, records, (lengths, per_px, samples), rule, limit_count
    ), members[is_long]


def _wave_jobs(plan, members, records, grids, rule, limit_count) -> Jobs:
    lengths, per_px, samples = grids
    survey, frames = plan.survey, plan.survey.frames
    middle_px = (survey.slope_low_px + survey.slope_high_px)[members] / 2.0
    center = np.rint(middle_px * per_px).astype(np.int64)
    size = np.minimum(lengths, np.ceil(samples).astype(np.int64) + 2 * EDGE_HALF_WIDTH)
    wavelength_um = frames.wavelength_nm[members, None] / 1000.0
    polynomial = frames.box_polynomial_um[members] / wavelength_um
    shift = frames.half_width_um_per_px[members] * center / per_px / wavelength_um
    polynomial[:, _TILTS] -= shift
    ellipse = math.pi / 4.0 * np.sqrt(1.0 - frames.shear_ratio[members] ** 2)
    area = ellipse * samples.prod(axis=1) * survey.passed_ratio[members]
    window = _windows(center, per_px, lengths, plan.radius_px[members])
    field_count = size[:, 1] * lengths[:, 0]
    stripe_count = np.maximum(window[:, 3] - window[:, 2] + 1, 0) * lengths[:, 0]
    cuts = _cuts(lengths, field_count, limit_count)
    tables, start, reach = _filters(per_px, rule.filter_half_width)
    records["polynomial"] = polynomial[:, _ORDER]
    records["light"][:, :2] = samples
    records["light"][:, 2] = 1.0 / (area * lengths.prod(axis=1))
    records["grid"] = np.concatenate([size, center], axis=1)
    records["place"][:, 3] = _before(field_count, cuts) // 2
    records["pixels"][:, :2] = per_px
    records["pixels"][:, 2] = _before(stripe_count, cuts)
    records["window"] = window
    records["taps"] = np.stack(
        [start[:, 0], reach[:, 0], start[:, 1], reach[:, 1]], axis=1
    )
    chunks = [
        Chunk(
            first=a,
            count=b - a,
            lengths=tuple(lengths[a].tolist()),
            scratch_count=int(field_count[a:b].sum()),
            largest=(int(size[a:b, 1].max()), 0),
            stripe_count=int(stripe_count[a:b].sum()),
        )
        for a, b in cuts
    ]
    is_apodised = bool(frames.log_amplitude[members].any())
    return Jobs(members, records, chunks, tables, is_apodised)


def plan_rays(
    plan: PsfPlan, members: NDArray[np.int64], starts, *, limit_count: int
) -> Jobs:
    """Jobs of ray optics; ``limit_count``: pixels of a chunk."""
    if members.size == 0:
        return _NO_JOBS
    survey, frames = plan.survey, plan.survey.frames
    share = plan.geometric_ratio[members]
    records = _common(plan, members, starts, share, 1)
    extent_px = survey.extent_px[members].max(axis=1)
    room = np.sqrt(1.0 - frames.shear_ratio[members] ** 2)
    n_cells = np.ceil(np.maximum(MIN_CELLS / room, CELLS_PER_PX * extent_px))
    n_cells = np.minimum(n_cells, MAX_CELLS).astype(np.int64)
    n_points = np.ceil(EDGE_POINTS_PER_PX * extent_px).astype(np.int64)
    n_points = np.maximum(n_points, MIN_EDGE_POINTS)
    passed = survey.passed_ratio[members]
    pixel_count = (2 * plan.radius_px[members] + 1) ** 2
    cuts = _cuts(np.zeros((members.size, 1)), pixel_count, limit_count)
    records["polynomial"] = frames.box_polynomial_um[members][:, _ORDER]
    records["more"][:, 3] = share < 1.0
    records["light"][:, 0] = passed
    records["light"][:, 1] = frames.wavelength_nm[members] / 1000.0
    # The cells' light by the pupil's area instead of their own sum: 1e-3 apart.
    cells_area = math.pi / 4.0 * n_cells**2 * room * passed
    records["light"][:, 2] = (1 << LIGHT_STEP_BITS) / cells_area
    records["grid"][:, 0], records["grid"][:, 1] = n_cells, n_points
    records["place"][:, 3] = _before(pixel_count, cuts)
    chunks = [
        Chunk(
            first=a,
            count=b - a,
            lengths=(0, 0),
            scratch_count=int(pixel_count[a:b].sum()),
            largest=(int(n_cells[a:b].max()), int(n_points[a:b].max())),
        )
        for a, b in cuts
    ]
    is_apodised = bool(frames.log_amplitude[members].any())
    return Jobs(members, records, chunks, np.zeros(0, np.float32), is_apodised)
