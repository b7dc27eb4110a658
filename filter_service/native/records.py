"""ctypes records that match the structs of `source/`, field by field."""

import ctypes as c

import numpy as np

POINTER = c.c_void_p


PSF_DONE, PSF_NO_MEMORY = 0, 2

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
        ("fraction", "<u2"),
        ("radius_px", "<u2"),
    ]
)
FRAGMENT_LIGHT = np.dtype([("rgb", "<f4", 3), ("depth", "<f4")])
BLOCK = np.dtype(
    [
        ("first", "<u4"),
        ("end", "<u4"),
        ("radius_px", "<u2"),
        ("has_edge", "u1"),
        ("merged", "u1"),
    ]
)
KERNEL_IMAGE_BYTES = 128
RECIPE_IMAGE_BYTES = 16


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
        ("row_scratch", POINTER),
        ("dpt", POINTER),
        ("position", POINTER),
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
        ("fragments", POINTER),
        ("lights", POINTER),
        ("boxes", POINTER * 4),
        ("blocks", POINTER),
        ("fragment_count", c.c_int64),
        ("merged_count", c.c_int64),
        ("farthest_px", c.c_int32),
        ("is_encoded", c.c_int32),
        ("store", POINTER * RESOLUTIONS),
        ("store_first", POINTER * RESOLUTIONS),
        ("store_reach", POINTER * RESOLUTIONS),
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
        ("picture", POINTER),
        ("output_kind", c.c_int32),
        ("failed", c.c_int32),
        ("entry_count", c.c_int64),
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


class PsfTables(c.Structure):
    """Tables of the PSF engine, see `source/psf_job.h`."""

    _fields_ = (
        ("monomials", POINTER),
        ("zernike_terms", POINTER),
        ("node_xy", POINTER),
        ("from_nodes", POINTER),
        ("slope_x", POINTER),
        ("slope_y", POINTER),
        ("edge_xy", POINTER),
        ("passed_powers", POINTER),
        ("ring_weights", POINTER),
        ("fresnel", POINTER),
        ("edge_response", POINTER),
        ("pixel_filters", POINTER),
        ("lengths", POINTER),
        ("twiddle_first", POINTER),
        ("twiddles", POINTER),
        ("cosine", c.c_float * 7),
        ("sine", c.c_float * 7),
        ("fresnel_limit", c.c_double),
        ("least_margin_px", c.c_double),
        ("base_db", c.c_double),
        ("per_rms_db", c.c_double),
        ("per_pixel_db", c.c_double),
        ("per_narrow_db", c.c_double),
        ("rays_from_db", c.c_double),
        ("fade_db", c.c_double),
        ("min_cells", c.c_double),
        ("max_cells", c.c_double),
        ("cells_per_px", c.c_double),
        ("min_edge_points", c.c_double),
        ("edge_points_per_px", c.c_double),
        ("min_curvature_ratio", c.c_double),
        ("far_px", c.c_double),
        ("near_px", c.c_double),
        ("centroid_ratio", c.c_double),
        ("fresnel_count", c.c_int32),
        ("edge_half_width", c.c_int32),
        ("edge_steps", c.c_int32),
        ("filter_stride", c.c_int32),
        ("filter_count", c.c_int32),
        ("filter_half_width", c.c_int32),
        ("length_count", c.c_int32),
        ("n_rings", c.c_int32),
        ("n_ring", c.c_int32),
        ("cut_steps", c.c_int32),
    )


class PsfJob(c.Structure):
    """Job that computes PSFs."""

    _fields_ = (
        ("threads", POINTER),
        ("tables", POINTER),
        ("zernike_um", POINTER),
        ("per_dpt_um", POINTER),
        ("circle_diameter_mm", POINTER),
        ("pupil_ellipse", POINTER),
        ("pixel_from_mrad", POINTER),
        ("wavelength_nm", POINTER),
        ("apodization_per_mm2", POINTER),
        ("apodization_center_mm", c.c_double * 2),
        ("ring_offset_mm", POINTER),
        ("ring_reach_mrad", POINTER),
        ("ring_tables", POINTER),
        ("ring_steps_per_mm2", c.c_double),
        ("ring_lattice_mm", c.c_double * 3),
        ("cut_ratio", c.c_double),
        ("oversampling", c.c_double),
        ("margin", c.c_double),
        ("groups", POINTER),
        ("channels", POINTER),
        ("total_dpt", POINTER),
        ("reach_px", POINTER),
        ("radius_px", POINTER),
        ("sizes", POINTER),
        ("peak_ratio", POINTER),
        ("spread_px", POINTER),
        ("lost_ratio", POINTER),
        ("rays_ratio", POINTER),
        ("outcome", POINTER),
        ("results", POINTER),
        ("count", c.c_int32),
        ("primaries", c.c_int32),
        ("max_radius_px", c.c_int32),
        ("is_diffracting", c.c_int32),
        ("min_samples_per_px", c.c_int32),
        ("ring_count", c.c_int32),
    )


def pointer_to(array: np.ndarray) -> int:
    """Return the address of an array's first element; the caller keeps it alive."""
    return int(array.ctypes.data)


SIZES = (
    c.sizeof(Frame),
    FRAGMENT.itemsize,
    BLOCK.itemsize,
    KERNEL_SHAPE.itemsize,
    KERNEL_IMAGE_BYTES,
    RECIPE_IMAGE_BYTES,
    c.sizeof(ShrinkJob),
    FRAGMENT_LIGHT.itemsize,
    c.sizeof(PsfJob),
    c.sizeof(PsfTables),
)
"""Expected result of `ocu_sizes`."""
