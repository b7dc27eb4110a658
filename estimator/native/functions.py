"""Signatures of the functions of `source/core.h`: parameters, and the result if any.

| parameter | Python | C |
|---|---|---|
| ``f8[]``, ``i4[]`` | array of this dtype, C-contiguous, or None | pointer or NULL |
| ``i8``, ``f8`` | number | ``int64_t``, ``double`` |
| ``record`` | `ctypes.Structure` | pointer |
| ``pool`` | handle of `Core.new_threads` | ``pool *`` |

A result is an ``int``.
"""

FUNCTIONS = {
    "psfs": "record -> int",
    "take_psfs": "record u2[]",
    "psf_discs": "record -> int",
    "frame_pupils": f"pool record i8 {4 * 'f8[] '} {4 * 'f8[] '}",
    "survey_pupils": f"pool record i8 {4 * 'f8[] '} {6 * 'f8[] '}",
    "needed_radii": f"i8 {4 * 'f8[] '} f8 i8 i8[]",
    "edge_lights_outside": f"i8 {5 * 'f8[] '}",
    "fill_defocus": "record",
    "trace_rays": "pool f8[] i8 f8[] f8[] i8 i8 f8[] f8[] f8[] i8[]",
    "trace_pupils": "record -> int",
    "trace_circles": "record -> int",
    "trace_shifts": "record -> int",
    "magnifications": "f8[] i8 i8 f8[] i8 f8[]",
    "gradient_indices": "f8[] i8 f8[] i8 f8[]",
    "hankel_table": f"{5 * 'f8[] '} i8 i8 i8 i8",
    "image_light": f"{5 * 'f8[] '} i8 i8 i8 i8 f8",
    "moved_fits": "pool f8[] f8[] f8[] f8[] i8 i8 i8 i8 f8[] -> int",
}
