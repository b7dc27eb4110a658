"""Kernels of light beyond ordinary kernels, its visibility, and its addition."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from estimator.psf.tables import N_EDGE
from filter_service.constants import DEPTH_SQUARE_PX, RGB
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.rendering.edge_kinds import BrightPixels, EyeAtFrame, SourceKinds
from filter_service.rgbd_view import RgbdView

N_PHI = 32
"""Directions from a source, of the tables of distant light."""

RHO_PX = 8.0 * 1.45 ** np.arange(10)
"""Distances from a source, of the tables of distant light.  Beyond the last, 227 px,
the light falls as the third power."""

FINE = 8
"""Steps between two distances in the tables."""

FADE_RATIO = 1.5
"""Ratio of the distances between which one grid replaces another."""


@lru_cache(maxsize=1)
def _directions() -> NDArray[np.float32]:
    """Return the directions (N_PHI, 2) of the tables of distant light."""
    angle = 2.0 * np.pi * np.arange(N_PHI) / N_PHI
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


@lru_cache(maxsize=64)
def places_around(
    inner_px: float, outer_px: float, pitch_px: int
) -> tuple[NDArray[np.float32], ...]:
    """Return factor, and position in the tables, of offsets (side, side).

    The factors fade in and out from two distances on.
    """
    half = math.ceil(FADE_RATIO * outer_px / pitch_px)
    y, x = np.mgrid[-half : half + 1, -half : half + 1] * float(pitch_px)
    rho_px = np.hypot(x, y)
    share = 1.0 - _faded(rho_px, outer_px)
    if inner_px:
        share -= 1.0 - _faded(rho_px, inner_px)
    rho_px = np.maximum(rho_px, RHO_PX[0])
    factor = share / rho_px**3
    if pitch_px > 1:
        # Distribution to coarse pixels and interpolation between them add this much to
        # the third power.
        factor /= 1.0 + 1.5 * (pitch_px / rho_px) ** 2
    # Between two distances, the tables are linear in the reciprocal.
    whole = np.minimum(np.searchsorted(RHO_PX, rho_px, side="right"), RHO_PX.size - 1)
    low, high = 1.0 / RHO_PX[whole - 1], 1.0 / RHO_PX[whole]
    part = np.clip((1.0 / rho_px - low) / (high - low), 0.0, 0.9999)
    phi_index = np.arctan2(y, x) / (2.0 * np.pi) * N_PHI % N_PHI
    return tuple(
        a.astype(np.float32) for a in (factor, FINE * (whole - 1 + part), phi_index)
    )


def _faded(rho_px: NDArray[np.float64], edge_px: float) -> NDArray[np.float64]:
    """Return a smooth step from 0 to 1 at a distance."""
    part = np.clip((rho_px / edge_px - 1.0) / (FADE_RATIO - 1.0), 0.0, 1.0)
    return part * part * (3.0 - 2.0 * part)


def distant_tables(
    elements: NDArray[np.float32],
    kernel_kind: NDArray[np.int64],
    seen: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the distant light times rho³ (n, N_PHI, n_fine, 3) of kernels.

    Parameters
    ----------
    elements : (n_kinds, 3, 8, N_EDGE)
        See `EdgeElements`.
    kernel_kind : (n,)
        Kind of each kernel.
    seen : (n, N_EDGE)
        Visible share of the edge from each element to the next.
    """
    count, n_fine = kernel_kind.size, FINE * (RHO_PX.size - 1) + 1
    found = np.empty((count, N_PHI, n_fine, RGB), np.float32)
    rho_px = RHO_PX.astype(np.float32)
    loops().call(
        "fill_polar",
        *(shared_threads(), elements, kernel_kind, seen, count),
        *(rho_px, rho_px.size, _directions(), N_PHI, FINE, found),
    )
    return found


def omitted_shares(
    state: EyeAtFrame,
    kinds: SourceKinds,
    own: NDArray[np.int64],
    maps: NDArray[np.float64],
    reach_px: NDArray[np.int64],
    *,
    side: int,
) -> NDArray[np.float32]:
    """Return the share (n, 3, side, side) of kernels that ends before each pixel.

    Parameters
    ----------
    own : (n,)
        Kinds to use.
    maps : (n, 2, 3, 2, 2)
        Maps to the pixels of stored kernels, see `FrameKernels`.
    reach_px : (n,)
        Largest reach of each kernel.
    """
    layers, image = state.layers, state.image
    tables, reads = state.handle.store.tables, layers.reads
    found = np.empty((own.size, RGB, side, side), np.float32)
    cells, lower = kinds.cell[own], kinds.interval[own]
    upper = np.minimum(lower + 1, layers.layer_dpt.size - 1)
    part = kinds.part_ratio[own]
    arrays = {
        "nodes": image.nodes[cells].astype(np.int64),
        "weight_ratio": image.weight_ratio[cells],
        "layer_dpt": layers.layer_dpt[np.stack([lower, upper], axis=-1)],
        "layer_ratio": np.stack([1.0 - part, part], axis=-1),
        "zero_dpt": np.ascontiguousarray(layers.layer_zero_dpt),
        "maps": maps,
        "reach_px": reach_px,
        "omitted": found,
    }
    job = records.OmittedJob(
        threads=shared_threads(),
        tables=records.StoreTables(**pointers(**tables._asdict())),
        reads=records.StateReads(
            **pointers(**reads._asdict()), count=reads.groups.size
        ),
        side=side,
        count=own.size,
        **pointers(**arrays),
    )
    loops().call("fill_omitted", job)
    return found


def light_kernels(
    elements: NDArray[np.float32],
    kernel_kind: NDArray[np.int64],
    seen: NDArray[np.float32],
    polar: NDArray[np.float32],
    places: tuple[NDArray[np.float32], ...],
    radius_px: NDArray[np.float32],
    omitted: NDArray[np.float32] | None = None,
    omitted_index: NDArray[np.int64] | None = None,
) -> NDArray[np.float32]:
    """Return kernels (n, side, side, 3) of light.

    Parameters
    ----------
    elements, kernel_kind, seen
        See `distant_tables`.
    polar : (n, N_PHI, n_fine, 3)
        Tables of distant light.
    places : 3 of (side, side)
        See `places_around`.
    radius_px : (n,)
        Distance up to which near light is computed from the elements.
    omitted : (k, 3, side, side), optional
        Share of kernels that ends before each pixel; none for distant light.
    omitted_index : (n,), optional
        Row of ``omitted`` of each kernel.
    """
    side, count = len(places[0]), kernel_kind.size
    found = np.empty((count, side, side, RGB), np.float32)
    arrays: dict[str, NDArray[Any]] = {
        **dict(zip(("share_ratio", "rho_index", "phi_index"), places, strict=True)),
        "polar": polar,
        "edges": elements,
        "kernel_kind": kernel_kind,
        "seen": seen,
        "radius_px": radius_px,
        "kernels": found,
    }
    if omitted is not None and omitted_index is not None:
        arrays |= {"omitted": omitted, "omitted_index": omitted_index}
    job = records.LightJob(
        threads=shared_threads(),
        n_phi=N_PHI,
        n_fine=polar.shape[2],
        side=side,
        count=count,
        **pointers(**arrays),
    )
    loops().call("fill_light", job)
    return found


def add_sources(
    plane: NDArray[np.float32],
    source_px: NDArray[np.float64],
    light: NDArray[np.float64],
    number: NDArray[np.int64],
    kernels: NDArray[np.float32],
    *,
    pitch_px: int,
    size_px: tuple[int, int],
    is_split: bool,
    is_image: bool = False,
) -> None:
    """Add sources times their kernels to a plane, from points of a grid.

    Parameters
    ----------
    plane : (rows, columns, 3)
        Of the pitch of the grid, or the image.
    source_px : (n, 2)
        x, y in pixels of the image.
    light : (n, 3)
    number : (n,)
        Kernel of each source, ascending.
    kernels : (n_kernels, side, side, 3)
        Round kernels.
    pitch_px : int
        Pitch of the grid.
    size_px : (height, width)
        Size of the image.
    is_split : bool
        Whether each source is divided between the four points around it, and not moved
        to the nearest.
    is_image : bool
        Whether the plane is the image; the pitch is odd.
    """
    shape = tuple(-(-n // pitch_px) + 2 for n in size_px)  # with a margin
    most = 4 * len(number)  # each source is divided between four points
    at, kernel = np.empty((most, 2), np.int64), np.empty(most, np.int64)
    gathered = np.zeros((most, RGB), np.float32)
    count = loops().call(
        "gather_points",
        *(source_px, number, light, len(number), pitch_px, is_split),
        *(np.full(shape, -1, np.int64), shape[1], at, kernel, gathered),
    )
    if is_image:  # centers of squares of an odd number of pixels
        at[:count] = pitch_px * at[:count] + pitch_px // 2
    loops().call(
        "add_sources",
        *(shared_threads(), at, kernel, gathered, count, kernels, kernels.shape[1]),
        *(plane, *plane.shape[:2]),
    )


def add_plane(coarse: NDArray[np.float32], image: NDArray[np.float32]) -> None:
    """Add light on pixels of twice the size, interpolated, to an image (h, w, 3)."""
    sizes = coarse.shape[:2], image.shape[:2]
    loops().call("add_plane", shared_threads(), coarse, *sizes[0], image, *sizes[1])


def seen_by_edges(
    view: RgbdView,
    pixels: BrightPixels,
    kinds: NDArray[np.int64],
    shift_px: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return which elements (n, N_EDGE) of the pupil's edge see sources, from 0 to 1.

    Parameters
    ----------
    pixels : BrightPixels
        Pixels of the view, and their n sources.
    kinds : (n,)
        Kind of each source.
    shift_px : (n_kinds, N_EDGE, 2)
        Displacement of rays to the elements, per diopter.
    """
    depth_m = np.ascontiguousarray(view.depth_m)
    rows, columns = (-(-n // DEPTH_SQUARE_PX) for n in depth_m.shape)
    least = np.empty((rows, columns), np.uint32)
    call, threads = loops().call, shared_threads()
    bits = depth_m.view(np.uint32)
    call("least_in_squares", threads, bits, *depth_m.shape, least)
    nearest_dpt = 1.0 / least.view(np.float32).astype(np.float64)
    x_px, y_px = np.ascontiguousarray(pixels.source_at_px.T)
    tangents = view.tangents if view.depth_kind == "planar" else (math.nan,) * 4
    seen = np.empty((x_px.size, N_EDGE), np.float32)
    arrays = {
        "x_px": x_px,
        "y_px": y_px,
        "object_dpt": pixels.object_dpt,
        "kinds": kinds,
        "is_hidden": pixels.source_surface > 0,
        "shift_px": shift_px,
        "depth_m": depth_m,
        "tangents": np.array(tangents, np.float64),
        "nearest_dpt": nearest_dpt,
        "seen": seen,
    }
    job = records.VisibilityJob(
        threads=threads,
        largest_dpt=nearest_dpt.max(),
        height=depth_m.shape[0],
        width=depth_m.shape[1],
        rows=rows,
        columns=columns,
        count=x_px.size,
        **pointers(**arrays),
    )
    call("see_sources", job)
    return seen
