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
}
