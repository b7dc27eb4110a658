"""ctypes records that match the structs of `source/`, field by field."""

import ctypes as c

import numpy as np

from estimator.native.records import pointer_to

POINTER = c.c_void_p

RESOLUTIONS = 3
"""Number of kernel resolutions: pixels of 1, 2 and 4 px."""

KERNEL_SHAPE = np.dtype(
    {
        "names": ["spread_px", "highest_level", "radius_px", "reach_px", "levels_used"],
        "formats": [("<f4", 2), "<i4", "<u2", ("u1", 4), "u1"],
        "offsets": [0, 8, 12, 14, 18],
        "itemsize": 20,
    }
)
FRAGMENT = np.dtype(
    [
        ("x", "<u2"),
        ("y", "<u2"),
        ("state", "<u4"),
        ("fraction", "<u4"),
    ]
)
FRAGMENT_LIGHT = np.dtype([("rgb", "<f4", 3), ("depth", "<f4")])
FRAGMENT_EXTRA = np.dtype([("strength", "<f4"), ("coverage", "<f4"), ("excess", "<f4")])
BLOCK = np.dtype(
    [
        ("first", "<u4"),
        ("end", "<u4"),
        ("first_cluster", "<u4"),
        ("end_cluster", "<u4"),
        ("radius_px", "<u2"),
        ("has_edge", "u1"),
        ("merged", "u1"),
    ]
)
CLUSTER_BYTES = 32
KERNEL_IMAGE_BYTES = 128
RECIPE_IMAGE_BYTES = 16


class AddedLight(c.Structure):
    """Light on squares that is added; `source/added_light.h` documents the fields."""

    _fields_ = (
        ("squares", POINTER),
        ("rows", c.c_int64),
        ("columns", c.c_int64),
    )


class Frame(c.Structure):
    """Argument of all stages; `source/frame.h` documents the fields."""

    _fields_ = (
        ("threads", POINTER),
        ("width", c.c_int32),
        ("height", c.c_int32),
        ("surface_count", c.c_int32),
        ("border_px", c.c_int32),
        ("image_width", c.c_int32),
        ("image_height", c.c_int32),
        ("block_columns", c.c_int32),
        ("block_rows", c.c_int32),
        ("color", POINTER * 2),
        ("color_kind", c.c_int32),
        ("depth_is_planar", c.c_int32),
        ("depth_m", POINTER * 2),
        ("tangents", c.c_float * 4),
        ("vergence_scale", c.c_float),
        ("vergence_offset_m", c.c_float),
        ("vergence_low_dpt", c.c_float),
        ("vergence_high_dpt", c.c_float),
        ("vergence_margin_dpt", c.c_float),
        ("blur_px_per_dpt", c.c_float),
        ("layer_dpt", POINTER),
        ("layer_per_dpt", POINTER),
        ("layer_count", c.c_int32),
        ("interval_count", c.c_int32),
        ("cell_px", c.c_int32),
        ("cell_columns", c.c_int32),
        ("corner_dpt", POINTER),
        ("column_cell", POINTER),
        ("column_share", POINTER),
        ("blend_column", POINTER),
        ("blend_row", POINTER),
        ("blend_across", POINTER),
        ("blend_down", POINTER),
        ("block_slots", c.c_int32),
        ("has_fine_kernels", c.c_int32),
        ("row_scratch", POINTER),
        ("dpt", POINTER),
        ("position", POINTER),
        ("block_light", POINTER),
        ("used", POINTER),
        ("missing_count", c.c_int64),
        ("clamped_count", c.c_int64),
        ("bad_color_count", c.c_int64),
        ("kernel_of", POINTER),
        ("shapes", POINTER),
        ("kernel_count", c.c_int32),
        ("max_level", c.c_int32),
        ("paper_rule", c.c_int32),
        ("white_level", c.c_float),
        ("tolerance", c.c_float),
        ("gaze_direction", c.c_float * 3),
        ("largest_reach_px", c.c_float),
        ("bright_pixels", c.c_int32),
        ("fragments", POINTER),
        ("lights", POINTER),
        ("extras", POINTER),
        ("blend_shares", POINTER),
        ("clusters", POINTER),
        ("boxes", POINTER * 4),
        ("blocks", POINTER),
        ("fragment_count", c.c_int64),
        ("merged_count", c.c_int64),
        ("farthest_px", c.c_int32),
        ("is_encoded", c.c_int32),
        ("store", POINTER * RESOLUTIONS),
        ("store_first", POINTER * RESOLUTIONS),
        ("store_reach", POINTER * RESOLUTIONS),
        ("store_words", c.c_uint64 * RESOLUTIONS),
        ("coarse_spread_px", c.c_float * RESOLUTIONS),
        ("recipes", POINTER),
        ("recipe_count", c.c_int32),
        ("recipe_images", POINTER),
        ("recipe_texels", POINTER),
        ("kernel_cells", POINTER),
        ("kernel_parts", POINTER),
        ("node_near", POINTER),
        ("node_far", POINTER),
        ("part_weights", POINTER),
        ("part_maps", POINTER),
        ("kernels", POINTER),
        ("kernel_texels", POINTER),
        ("blend_scratch", POINTER),
        ("blend_scratch_floats", c.c_uint64),
        ("recipe_texel_count", c.c_uint64),
        ("kernel_texel_count", c.c_uint64),
        ("kernel_gap_count", c.c_uint64),
        ("picture", POINTER),
        ("output_kind", c.c_int32),
        ("failed", c.c_int32),
        ("entry_count", c.c_int64),
        ("added", AddedLight),
    )


class ShrinkJob(c.Structure):
    """Job that downsamples kernels of a store."""

    _fields_ = (
        ("threads", POINTER),
        ("from_words", POINTER),
        ("from_first", POINTER),
        ("from_reach", POINTER),
        ("to_words", POINTER),
        ("to_first", POINTER),
        ("to_reach", POINTER),
        ("kernels", POINTER),
        ("resolution", c.c_int32),
        ("count", c.c_int32),
    )


class StoreTables(c.Structure):
    """Tables of a store, see `filter_service.psfs.pack`."""

    _fields_ = (
        ("values_dpt", POINTER),
        ("starts", POINTER),
        ("channel_shift_dpt", POINTER),
        ("offsets", POINTER),
        ("reach_words", POINTER),
        ("radius_px", POINTER),
        ("blur_px", POINTER),
        ("spread_px", POINTER),
        ("peak_ratio", POINTER),
        ("is_computed", POINTER),
        ("last_used", POINTER),
    )


class StateReads(c.Structure):
    """Nodes that a state reads, see `filter_service.psfs.pack`."""

    _fields_ = (
        ("groups", POINTER),
        ("scales", POINTER),
        ("weights", POINTER),
        ("count", c.c_int64),
    )


class MapTables(c.Structure):
    """Maps of cells, see `filter_service.rendering.image_cells`."""

    _fields_ = (
        ("node_from_cell", POINTER),
        ("cell_from_node", POINTER),
        ("area_ratio", POINTER),
        ("box_ratio", POINTER),
        ("stretch_ratio", POINTER),
        ("change_ratio", POINTER),
    )


class ListJob(c.Structure):
    """Job that lists kernels; `source/kernel_job.h` documents the fields."""

    _fields_ = (
        ("used", POINTER),
        ("cell_nodes", POINTER),
        ("n_cells", c.c_int64),
        ("n_intervals", c.c_int64),
        ("n_fields", c.c_int64),
        ("n_layers", c.c_int64),
        ("cells", POINTER),
        ("intervals", POINTER),
        ("parts", POINTER),
        ("kernel_of", POINTER),
        ("fields", POINTER),
        ("node_intervals", POINTER),
        ("near", POINTER),
        ("far", POINTER),
        ("recipe_fields", POINTER),
        ("recipe_layers", POINTER),
        ("marks", POINTER),
        ("count", c.c_int64),
        ("node_count", c.c_int64),
        ("recipe_count", c.c_int64),
    )


class RecipeJob(c.Structure):
    """Job that plans node kernels; `source/kernel_job.h` documents the fields."""

    _fields_ = (
        ("tables", StoreTables),
        ("reads", StateReads),
        ("fields", POINTER),
        ("layers", POINTER),
        ("layer_dpt", POINTER),
        ("layer_zero_dpt", POINTER),
        ("words", POINTER),
        ("reach_px", POINTER),
        ("radius_px", POINTER),
        ("peak_ratio", POINTER),
        ("spread_px", POINTER),
        ("near", POINTER),
        ("far", POINTER),
        ("node_reach_px", POINTER),
        ("node_radius_px", POINTER),
        ("node_peak_ratio", POINTER),
        ("missing", POINTER),
        ("count", c.c_int64),
        ("node_count", c.c_int64),
        ("frame_number", c.c_uint32),
    )


class VisibilityJob(c.Structure):
    """Job for the visibility of sources; `source/edge_job.h` documents the fields."""

    _fields_ = (
        ("threads", POINTER),
        ("x_px", POINTER),
        ("y_px", POINTER),
        ("object_dpt", POINTER),
        ("kinds", POINTER),
        ("is_hidden", POINTER),
        ("shift_px", POINTER),
        ("depth_m", POINTER),
        ("tangents", POINTER),
        ("nearest_dpt", POINTER),
        ("seen", POINTER),
        ("largest_dpt", c.c_double),
        ("height", c.c_int64),
        ("width", c.c_int64),
        ("rows", c.c_int64),
        ("columns", c.c_int64),
        ("count", c.c_int64),
    )


class OmittedJob(c.Structure):
    """Job that finds where kernels end; `source/edge_job.h` documents the fields."""

    _fields_ = (
        ("threads", POINTER),
        ("tables", StoreTables),
        ("reads", StateReads),
        ("nodes", POINTER),
        ("weight_ratio", POINTER),
        ("layer_dpt", POINTER),
        ("layer_ratio", POINTER),
        ("zero_dpt", POINTER),
        ("maps", POINTER),
        ("reach_px", POINTER),
        ("omitted", POINTER),
        ("side", c.c_int64),
        ("count", c.c_int64),
    )


class LightJob(c.Structure):
    """Job that computes light around sources; see `source/edge_job.h`."""

    _fields_ = (
        ("threads", POINTER),
        ("share_ratio", POINTER),
        ("rho_index", POINTER),
        ("phi_index", POINTER),
        ("polar", POINTER),
        ("edges", POINTER),
        ("kernel_kind", POINTER),
        ("seen", POINTER),
        ("radius_px", POINTER),
        ("omitted", POINTER),
        ("omitted_index", POINTER),
        ("kernels", POINTER),
        ("n_phi", c.c_int64),
        ("n_fine", c.c_int64),
        ("side", c.c_int64),
        ("count", c.c_int64),
    )


class TailsJob(c.Structure):
    """Job that computes the tails of kernels; see `source/edge_job.h`."""

    _fields_ = (
        ("threads", POINTER),
        ("tables", StoreTables),
        ("reads", StateReads),
        ("nodes", POINTER),
        ("weight_ratio", POINTER),
        ("layer_dpt", POINTER),
        ("layer_ratio", POINTER),
        ("zero_dpt", POINTER),
        ("maps", POINTER),
        ("edges", POINTER),
        ("step_px", POINTER),
        ("near", POINTER),
        ("far", POINTER),
        ("count", c.c_int64),
    )


MEANS_LEVELS, MAX_LEVELS = 4, 8
"""Levels of squares with mean light, and largest number of levels; `edge_job.h`."""


class SpreadJob(c.Structure):
    """Job that adds the tails of kernels; see `source/edge_job.h`."""

    _fields_ = (
        ("threads", POINTER),
        ("kinds", POINTER),
        ("near", POINTER),
        ("far", POINTER),
        ("powers", POINTER),
        ("levels", POINTER * MEANS_LEVELS),
        ("planes", POINTER * MAX_LEVELS),
        ("rows", c.c_int64),
        ("columns", c.c_int64),
        ("block_rows", c.c_int64),
        ("block_columns", c.c_int64),
        ("count", c.c_int64),
        ("n_levels", c.c_int32),
    )


class SizeJob(c.Structure):
    """Job that plans kernels; `source/kernel_job.h` documents the fields."""

    _fields_ = (
        ("cell_maps", MapTables),
        ("cell_weight_ratio", POINTER),
        ("cells", POINTER),
        ("parts", POINTER),
        ("node_reach_px", POINTER),
        ("node_radius_px", POINTER),
        ("node_peak_ratio", POINTER),
        ("near", POINTER),
        ("far", POINTER),
        ("recipe_spread_px", POINTER),
        ("weight_ratio", POINTER),
        ("maps", POINTER),
        ("reach_px", POINTER),
        ("radius_px", POINTER),
        ("peak_ratio", POINTER),
        ("spread_px", POINTER),
        ("count", c.c_int64),
    )


def pointers(**arrays: np.ndarray) -> dict[str, int]:
    """Return the addresses of contiguous arrays, which the caller keeps alive.

    Raises
    ------
    TypeError
    """
    for name, array in arrays.items():
        if not array.flags.c_contiguous:
            raise TypeError(f"{name}: strides {array.strides}; expected contiguous")
    return {name: pointer_to(array) for name, array in arrays.items()}


class NodeJob(c.Structure):
    """Job that counts the intervals between nodes, see `source/node_job.h`."""

    _fields_ = (
        ("covariance", POINTER),
        ("unit_px", POINTER),
        ("light_ratio", POINTER),
        ("foci_dpt", POINTER),
        ("groups", POINTER),
        ("lows", POINTER),
        ("highs", POINTER),
        ("shifts_dpt", POINTER),
        ("needed", POINTER),
        ("error", c.c_double),
        ("doubling", c.c_double),
        ("blur_exponent", c.c_double),
        ("sharp_px", c.c_double),
        ("own_share", c.c_double),
        ("diffraction_share", c.c_double),
        ("n", c.c_int64),
        ("n_groups", c.c_int64),
        ("n_foci", c.c_int64),
        ("n_shifts", c.c_int64),
        ("n_samples", c.c_int64),
    )


SIZES = (
    c.sizeof(Frame),
    FRAGMENT.itemsize,
    BLOCK.itemsize,
    CLUSTER_BYTES,
    KERNEL_SHAPE.itemsize,
    KERNEL_IMAGE_BYTES,
    RECIPE_IMAGE_BYTES,
    c.sizeof(ShrinkJob),
    FRAGMENT_LIGHT.itemsize,
    c.sizeof(RecipeJob),
    c.sizeof(SizeJob),
    c.sizeof(VisibilityJob),
    c.sizeof(OmittedJob),
    c.sizeof(LightJob),
    c.sizeof(NodeJob),
    c.sizeof(ListJob),
    c.sizeof(TailsJob),
    c.sizeof(SpreadJob),
)
"""Expected result of `ocu_sizes`."""
