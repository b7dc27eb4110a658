"""Signatures of the functions of `source/loops.h`; see `estimator.native.functions`."""

FUNCTIONS = {
    "pixels": "record",
    "merge": "record",
    "place": "record",
    "blend": "record",
    "splat": "record",
    "shrink": "record",
}
