"""ctypes records that match the structs of `source/`, field by field."""

import ctypes as c

import numpy as np

POINTER = c.c_void_p

PSF_DONE, PSF_NO_MEMORY = 0, 2


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
        ("fresnel_count", c.c_int32),
        ("edge_half_width", c.c_int32),
        ("edge_steps", c.c_int32),
        ("filter_stride", c.c_int32),
        ("filter_count", c.c_int32),
        ("filter_half_width", c.c_int32),
        ("length_count", c.c_int32),
        ("n_rings", c.c_int32),
        ("n_ring", c.c_int32),
        ("order", c.c_int32),
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
        ("centroid_ratio", c.c_double),
        ("oversampling", c.c_double),
        ("margin", c.c_double),
        ("nodes", POINTER),
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
        ("cut_steps", c.c_int32),
    )


class PsfDiscsJob(c.Structure):
    """Job that computes PSFs over discs."""

    _fields_ = (
        ("job", POINTER),
        ("box_um", POINTER),
        ("half_width", POINTER),
        ("shear", POINTER),
        ("log_amplitude", POINTER),
        ("wavelength_um", POINTER),
        ("low_px", POINTER),
        ("high_px", POINTER),
        ("edge_px", POINTER),
        ("normal", POINTER),
        ("edge_um", POINTER),
        ("passed_ratio", POINTER),
        ("pixel_from_mrad", POINTER),
        ("ring_offset_mm", POINTER),
        ("ring_channels", POINTER),
        ("rays_ratio", POINTER),
        ("radius_px", POINTER),
        ("first", POINTER),
        ("kernels", POINTER),
        ("light_ratio", POINTER),
        ("outcome", POINTER),
        ("count", c.c_int64),
    )


class DefocusGrid(c.Structure):
    """Traced values, see `source/defocus_job.h`."""

    _fields_ = (
        ("pupils_mm", POINTER),
        ("powers", POINTER),
        ("accommodations_dpt", POINTER),
        ("values", POINTER),
        ("channel_count", c.c_int64),
        ("pupil_count", c.c_int64),
        ("accommodation_count", c.c_int64),
    )


class DefocusJob(c.Structure):
    """Job that computes the total defocus of fixed fields."""

    _fields_ = (
        ("field", DefocusGrid),
        ("axis", DefocusGrid),
        ("fields", POINTER),
        ("channels", POINTER),
        ("open_mm", POINTER),
        ("always", POINTER),
        ("fading", POINTER),
        ("fading_mm", c.c_double),
        ("scratch", POINTER),
        ("found_dpt", POINTER),
        ("pupil_mm", c.c_double),
        ("accommodation_dpt", c.c_double),
        ("overshoot", c.c_double),
        ("sphere_per_c20", c.c_double),
        ("count", c.c_int64),
    )


class WavefrontJob(c.Structure):
    """Job that traces wavefronts or chief rays, see `source/wavefront_job.h`."""

    _fields_ = (
        ("threads", POINTER),
        ("packed", POINTER),
        ("indices", POINTER),
        ("eyes", POINTER),
        ("index_rows", POINTER),
        ("reference_rows", POINTER),
        ("fields_rad", POINTER),
        ("radii_mm", POINTER),
        ("pupil_z_mm", POINTER),
        ("rings", POINTER),
        ("ring_weights", POINTER),
        ("azimuths", POINTER),
        ("monomials", POINTER),
        ("projection", POINTER),
        ("results", POINTER),
        ("object_dpt", c.c_double),
        ("count", c.c_int64),
        ("n_rows", c.c_int64),
        ("n_indices", c.c_int64),
        ("n_radii", c.c_int64),
        ("n_rings", c.c_int64),
        ("n_azimuths", c.c_int64),
        ("n_terms", c.c_int64),
        ("at_pupil", c.c_int64),
        ("by_slopes", c.c_int64),
        ("only_whole", c.c_int64),
    )


def pointer_to(array: np.ndarray) -> int:
    """Return the address of an array's first element; the caller keeps it alive."""
    # `array.ctypes` is a new object, and takes four times as long
    return int(array.__array_interface__["data"][0])


SIZES = tuple(
    c.sizeof(record)
    for record in (PsfJob, PsfTables, PsfDiscsJob, DefocusJob, WavefrontJob)
)
"""Expected result of `ocu_sizes`."""
