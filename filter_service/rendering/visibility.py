"""Which points of the pupil's edge see a source, from the depth of a view."""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from estimator.psf.tables import N_EDGE
from filter_service.constants import DEPTH_SQUARE_PX
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.rendering.bright_pixels import BrightPixels
from filter_service.rgbd_view import RgbdView


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
