"""Kernels of the light that the edges of pupils send beyond ordinary kernels."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from filter_service.constants import RGB
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.rendering.edge_kinds import EyeAtFrame, SourceKinds

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
    maps : (n, 3, 2, 2)
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
